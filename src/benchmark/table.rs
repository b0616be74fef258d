use std::fmt;

use super::report::{CascadeFigures, LayerFigures, Program, Report, Start};
use crate::gpu::Precision;

/// Columns side by side: names on the left, numbers on the right.
pub(crate) struct Table {
    names: usize,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// The first `names` columns hold names.
    pub fn new(names: usize, header: &[&str]) -> Self {
        Self {
            names,
            rows: vec![header.iter().map(|&cell| cell.to_owned()).collect()],
        }
    }

    pub fn row(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let mut widths = vec![0; columns];
        for row in &self.rows {
            for (width, cell) in widths.iter_mut().zip(row) {
                *width = cell.chars().count().max(*width);
            }
        }
        for row in &self.rows {
            let mut line = String::new();
            for (column, (cell, &width)) in row.iter().zip(&widths).enumerate() {
                line += "  ";
                line += &if column < self.names {
                    format!("{cell:width$}")
                } else {
                    format!("{cell:>width$}")
                };
            }
            writeln!(f, "{}", line.trim_end())?;
        }
        Ok(())
    }
}

/// So many digits behind the point; `-` for what was not measured.
pub(super) fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".to_owned(), |v| format!("{v:.digits$}"))
}

/// Milliseconds: a microsecond shows.
fn ms(value: Option<f64>) -> String {
    number(value, 3)
}

fn percent(share: Option<f64>) -> String {
    share.map_or("-".to_owned(), |share| format!("{:.0} %", 100.0 * share))
}

/// For people.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "adapter   {}", self.adapter)?;
        writeln!(f, "weights   {}", self.weights)?;
        writeln!(f, "program   {}", self.program)?;
        if let Some(roofline) = &self.roofline {
            writeln!(
                f,
                "reach     {:.1} GFLOP/s in registers, {:.1} GB/s through memory, measured with two tiny kernels",
                roofline.gflop_per_s, roofline.gb_per_s,
            )?;
        }
        for first in first_of_each_precision(&self.cascade) {
            self.write_layers(f, first)?;
        }
        self.write_cascade(f)?;
        if let Some(start) = &self.start {
            write!(f, "\n{start}")?;
        }
        Ok(())
    }
}

impl Report {
    /// The layers of the batch of `shown` in full, and what an image takes at other batch sizes.
    fn write_layers(&self, f: &mut fmt::Formatter<'_>, shown: &CascadeFigures) -> fmt::Result {
        let of = |batch: usize| {
            let same = move |l: &&LayerFigures| l.batch == batch && l.precision == shown.precision;
            self.layers.iter().filter(same)
        };
        let others: Vec<usize> = self
            .cascade
            .iter()
            .filter(|c| c.precision == shown.precision && c.batch != shown.batch)
            .map(|c| c.batch)
            .collect();
        writeln!(
            f,
            "\nLayers, batch {}, {}: {}, medians",
            shown.batch, shown.precision, self.timing
        )?;
        let mut header = vec![
            "layer", "kernel", "GFLOP", "MB", "ms", "best", "of time", "GFLOP/s", "GB/s",
        ];
        if self.roofline.is_some() {
            header.push("of reach");
        }
        let more: Vec<String> = others
            .iter()
            .map(|batch| format!("ms/image at {batch}"))
            .collect();
        header.extend(more.iter().map(String::as_str));
        let mut table = Table::new(2, &header);
        let total: f64 = of(shown.batch).map(|layer| layer.ms_p50).sum();
        let some = |value: f64| Some(value).filter(|&v| v > 0.0);
        let mut sums = [0.0; 2];
        let mut other_sums = vec![0.0; others.len()];
        for layer in of(shown.batch) {
            let mut cells = vec![
                layer.layer.clone(),
                layer.kernel.clone(),
                number(some(layer.gflop), 3),
                number(Some(layer.mb), 2),
                ms(Some(layer.ms_p50)),
                ms(Some(layer.ms_min)),
                percent(some(total).map(|total| layer.ms_p50 / total)),
                number(layer.gflop_per_s.and_then(some), 1),
                number(layer.gb_per_s, 2),
            ];
            if self.roofline.is_some() {
                cells.push(percent(layer.roofline_share));
            }
            for (&batch, sum) in others.iter().zip(&mut other_sums) {
                let image = of(batch)
                    .find(|other| other.layer == layer.layer)
                    .map(|other| other.ms_p50 / batch as f64);
                *sum += image.unwrap_or_default();
                cells.push(ms(image));
            }
            table.row(cells);
            sums[0] += layer.gflop;
            sums[1] += layer.mb;
        }
        let [gflop, mb] = sums;
        let mut cells = vec![
            "all".to_owned(),
            String::new(),
            number(Some(gflop), 3),
            number(Some(mb), 2),
            ms(Some(total)),
            ms(Some(of(shown.batch).map(|layer| layer.ms_min).sum())),
            percent(some(total).map(|_| 1.0)),
            number(some(total).map(|total| gflop / total * 1e3), 1),
            number(some(total).map(|total| mb / total), 2),
        ];
        if self.roofline.is_some() {
            // What each layer would take at its own reach, of what it took.
            let reached = of(shown.batch)
                .filter_map(|layer| Some(layer.roofline_share? * layer.ms_p50))
                .sum::<f64>();
            cells.push(percent(some(total).map(|total| reached / total)));
        }
        cells.extend(other_sums.iter().map(|&sum| ms(Some(sum))));
        table.row(cells);
        write!(f, "{table}")?;
        if self.roofline.is_some() {
            writeln!(
                f,
                "  of reach: how near the adapter's reach the layer's arithmetic or memory comes, whichever \
                 binds;\n  more than 100 % where data stays in caches, or is read more than written"
            )?;
        }
        Ok(())
    }

    fn write_cascade(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.image;
        writeln!(
            f,
            "\nCascade: from images of {width} x {height} in memory to the answer in memory; medians in ms"
        )?;
        let on_gpu = self.roofline.is_some();
        let mut header = vec!["batch", "precision", "images/s"];
        if on_gpu {
            header.push("GPU ms");
        }
        header.extend(["wall ms", "best", "p95", "p99"]);
        if on_gpu {
            header.extend([
                "upload", "compute", "readback", "CPU us", "GPU MB", "plan ms",
            ]);
        }
        header.extend(["first ms", "runs"]);
        let mut table = Table::new(2, &header);
        for c in &self.cascade {
            let mut cells = vec![
                c.batch.to_string(),
                c.precision.to_string(),
                number(Some(c.frames_per_s), 2),
            ];
            if on_gpu {
                cells.push(ms(c.gpu_ms_p50));
            }
            cells.extend(
                [c.wall_ms_p50, c.wall_ms_min, c.wall_ms_p95, c.wall_ms_p99].map(|v| ms(Some(v))),
            );
            if on_gpu {
                cells.extend([c.upload_ms_p50, c.compute_ms_p50, c.readback_ms_p50].map(ms));
                cells.push(number(c.cpu_us_p50, 0));
                cells.push(number(c.memory_mb, 1));
                cells.push(number(c.plan_ms, 0));
            }
            cells.push(number(Some(c.first_ms), 0));
            cells.push(c.runs.to_string());
            table.row(cells);
        }
        write!(f, "{table}")?;
        if on_gpu {
            writeln!(
                f,
                "  CPU us: encode, submit and readback, in us; the images' way to the GPU falls into compute"
            )?;
        }
        Ok(())
    }
}

fn first_of_each_precision(cascade: &[CascadeFigures]) -> Vec<&CascadeFigures> {
    let first = |precision: Precision| cascade.iter().find(|c| c.precision == precision);
    [Precision::F32, Precision::F16]
        .into_iter()
        .filter_map(first)
        .collect()
}

impl fmt::Display for Program {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "whereabot {}, {}", self.version, self.target)?;
        if self.debug {
            f.write_str(", a debug build: slower than a release build")?;
        }
        Ok(())
    }
}

impl fmt::Display for Start {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "From the start of a process to its first result")?;
        let cold = self
            .cold_ms
            .map_or("-".to_owned(), |ms| format!("{ms:.0} ms"));
        writeln!(f, "  cold  {cold}")?;
        writeln!(f, "  warm  {:.0} ms", self.warm_ms)?;
        writeln!(f, "  {}", self.note)
    }
}
