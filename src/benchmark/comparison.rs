use std::fmt::Write as _;

use super::report::{CascadeFigures, LayerFigures, Report};
use super::table::{Table, ms, number};

/// What `new` takes of the time of `old`, layer by layer and batch by batch, for people. `names` say
/// where the two come from.
pub fn compare((old_name, new_name): (&str, &str), old: &Report, new: &Report) -> String {
    let mut text =
        String::from("Comparison: ratios are new / old; below 1 the new one is faster\n");
    for (which, name, report) in [("old", old_name, old), ("new", new_name, new)] {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "  {which}  {name}\n       {}\n       {}\n       {}",
            report.adapter, report.weights, report.program
        );
    }
    for difference in differences(old, new) {
        let _ = writeln!(text, "  not the same: {difference}");
    }

    let cascade: Vec<(&CascadeFigures, &CascadeFigures)> = old
        .cascade
        .iter()
        .filter_map(|o| {
            let same = |n: &&CascadeFigures| (n.batch, n.precision) == (o.batch, o.precision);
            new.cascade.iter().find(same).map(|n| (o, n))
        })
        .collect();
    if cascade.is_empty() {
        text += "\nNothing to compare: no batch size and precision that both measured.\n";
        return text;
    }

    text += "\nCascade, median ms\n";
    let mut table = Table::new(
        2,
        &[
            "batch",
            "precision",
            "wall old",
            "new",
            "ratio",
            "GPU old",
            "new",
            "ratio",
            "images/s old",
            "new",
        ],
    );
    for (o, n) in &cascade {
        let mut cells = vec![o.batch.to_string(), o.precision.to_string()];
        cells.extend(triple(Some(o.wall_ms_p50), Some(n.wall_ms_p50)));
        cells.extend(triple(o.gpu_ms_p50, n.gpu_ms_p50));
        cells.extend([o, n].map(|c| number(Some(c.frames_per_s), 2)));
        table.row(cells);
    }
    text += &table.to_string();

    for (o, _) in &cascade {
        let of = |report: &Report| -> Vec<LayerFigures> {
            let same = |l: &&LayerFigures| l.batch == o.batch && l.precision == o.precision;
            report.layers.iter().filter(same).cloned().collect()
        };
        let _ = writeln!(
            text,
            "\nLayers, batch {}, {}, median ms",
            o.batch, o.precision
        );
        text += &layers(&of(old), &of(new)).to_string();
    }

    if let (Some(o), Some(n)) = (&old.start, &new.start) {
        text += "\nFrom the start of a process to its first result, ms\n";
        let mut table = Table::new(1, &["", "old", "new", "ratio"]);
        let rows = [
            ("cold", o.cold_ms, n.cold_ms),
            ("warm", Some(o.warm_ms), Some(n.warm_ms)),
        ];
        for (name, o, n) in rows {
            let mut cells = vec![name.to_owned()];
            cells.extend(triple(o, n));
            table.row(cells);
        }
        text += &table.to_string();
    }
    text
}

/// What makes figures something else than a comparison of two programs.
fn differences(old: &Report, new: &Report) -> Vec<String> {
    let mut all = Vec::new();
    let mut differ = |what: &str, old: String, new: String| {
        if old != new {
            all.push(format!("{what}: {old} and {new}"));
        }
    };
    differ("adapters", old.adapter.to_string(), new.adapter.to_string());
    differ(
        "CPU threads",
        old.adapter.cpu_threads.to_string(),
        new.adapter.cpu_threads.to_string(),
    );
    differ("weights", old.weights.to_string(), new.weights.to_string());
    differ("programs", old.program.to_string(), new.program.to_string());
    differ(
        "layers were timed by",
        old.timing.to_string(),
        new.timing.to_string(),
    );
    let size = |report: &Report| format!("{} x {}", report.image[0], report.image[1]);
    differ("images", size(old), size(new));
    all
}

fn layers(old: &[LayerFigures], new: &[LayerFigures]) -> Table {
    let mut table = Table::new(2, &["layer", "kernel", "old", "new", "ratio"]);
    let mut row = |name: &str, kernel: String, o: Option<f64>, n: Option<f64>| {
        let mut cells = vec![name.to_owned(), kernel];
        cells.extend(triple(o, n));
        table.row(cells);
    };
    for o in old {
        let n = new.iter().find(|n| n.layer == o.layer);
        let kernel = match n {
            Some(n) if n.kernel != o.kernel => format!("{} -> {}", o.kernel, n.kernel),
            Some(_) => o.kernel.clone(),
            None => format!("{} (old only)", o.kernel),
        };
        row(&o.layer, kernel, Some(o.ms_p50), n.map(|n| n.ms_p50));
    }
    for n in new {
        if !old.iter().any(|o| o.layer == n.layer) {
            let kernel = format!("{} (new only)", n.kernel);
            row(&n.layer, kernel, None, Some(n.ms_p50));
        }
    }
    let sum = |layers: &[LayerFigures]| Some(layers.iter().map(|layer| layer.ms_p50).sum());
    row("all", String::new(), sum(old), sum(new));
    table
}

/// Old, new, and new by old.
fn triple(old: Option<f64>, new: Option<f64>) -> [String; 3] {
    let ratio = match (old, new) {
        (Some(old), Some(new)) if old > 0.0 => format!("{:.2}", new / old),
        _ => "-".to_owned(),
    };
    [ms(old), ms(new), ratio]
}
