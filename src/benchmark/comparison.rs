use std::fmt::Write as _;

use super::report::{CascadeFigures, LayerFigures, Report};
use super::table::{Table, number};

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

    text += "\nCascade, ms: medians, and the ratio of the shortest\n";
    let header = [
        "batch",
        "precision",
        "wall old",
        "new",
        "ratio",
        "of best",
        "GPU old",
        "new",
        "ratio",
        "of best",
    ];
    let mut table = Table::new(2, &header);
    for (o, n) in &cascade {
        let mut cells = vec![o.batch.to_string(), o.precision.to_string()];
        cells.extend(ratios(Some(o.wall_ms_p50), Some(n.wall_ms_p50), 3));
        cells.push(ratio(Some(o.wall_ms_min), Some(n.wall_ms_min)));
        cells.extend(ratios(o.gpu_ms_p50, n.gpu_ms_p50, 3));
        cells.push(ratio(o.gpu_ms_min, n.gpu_ms_min));
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
            "\nLayers, batch {}, {}, ms: medians, and the ratio of the shortest",
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
            cells.extend(ratios(o, n, 0));
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
    let mut table = Table::new(2, &["layer", "kernel", "old", "new", "ratio", "of best"]);
    let mut row = |name: &str, kernel: String, old: Option<[f64; 2]>, new: Option<[f64; 2]>| {
        let [p50, min] = [0, 1].map(|index| (old.map(|ms| ms[index]), new.map(|ms| ms[index])));
        let mut cells = vec![name.to_owned(), kernel];
        cells.extend(ratios(p50.0, p50.1, 3));
        cells.push(ratio(min.0, min.1));
        table.row(cells);
    };
    let times = |layer: &LayerFigures| [layer.ms_p50, layer.ms_min];
    for o in old {
        let n = new.iter().find(|n| n.layer == o.layer);
        let kernel = match n {
            Some(n) if n.kernel != o.kernel => format!("{} -> {}", o.kernel, n.kernel),
            Some(_) => o.kernel.clone(),
            None => format!("{} (old only)", o.kernel),
        };
        row(&o.layer, kernel, Some(times(o)), n.map(times));
    }
    for n in new {
        if !old.iter().any(|o| o.layer == n.layer) {
            let kernel = format!("{} (new only)", n.kernel);
            row(&n.layer, kernel, None, Some(times(n)));
        }
    }
    let sum = |layers: &[LayerFigures]| {
        let zero = [0.0; 2];
        let add = |[p50, min]: [f64; 2], layer| {
            let [a, b] = times(layer);
            [p50 + a, min + b]
        };
        Some(layers.iter().fold(zero, add))
    };
    row("all", String::new(), sum(old), sum(new));
    table
}

/// Old and new milliseconds, and new by old.
fn ratios(old: Option<f64>, new: Option<f64>, digits: usize) -> [String; 3] {
    [number(old, digits), number(new, digits), ratio(old, new)]
}

fn ratio(old: Option<f64>, new: Option<f64>) -> String {
    match (old, new) {
        (Some(old), Some(new)) if old > 0.0 => format!("{:.2}", new / old),
        _ => "-".to_owned(),
    }
}
