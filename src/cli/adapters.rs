//! `whereabot adapters`: what there is to run on.

use std::process::ExitCode;

use serde_json::json;

use crate::gpu::{self, AdapterReport, AdapterRequest, Choice, GpuError, list_adapters};

/// List the graphics adapters, and say which one `locate` would use and why
///
/// WGPU_BACKEND (vulkan, metal, dx12, gl) and WGPU_ADAPTER_NAME are honoured.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// One JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let (reports, choice) = list_adapters(&AdapterRequest::new(None, None))?;
    let text = if args.json {
        format!("{:#}\n", as_json(&reports, &choice))
    } else {
        as_table(&reports, &choice)
    };
    super::print(&text)?;
    match choice {
        Ok(_) | Err(GpuError::NoAdapter { .. }) => Ok(ExitCode::SUCCESS),
        Err(error) => Err(error.into()),
    }
}

fn as_json(reports: &[AdapterReport], choice: &Result<Choice, GpuError>) -> serde_json::Value {
    let adapters: Vec<_> = reports
        .iter()
        .enumerate()
        .map(|(index, report)| {
            let mut adapter = json!({
                "index": index,
                "name": report.info.name,
                "type": gpu::device_type(&report.info),
                "backend": report.info.backend.to_str(),
                "driver": gpu::driver(&report.info),
                "tier": report.tier.to_string(),
                "usable": report.unusable.is_none(),
            });
            if let Some(problem) = &report.unusable {
                adapter["problem"] = json!(problem);
            }
            adapter
        })
        .collect();
    let mut answer = json!({"schema": 1, "adapters": adapters});
    match choice {
        Ok(choice) => answer["used"] = json!({"index": choice.index, "reason": choice.reason}),
        Err(error) => answer["problem"] = json!(error.to_string()),
    }
    answer
}

fn as_table(reports: &[AdapterReport], choice: &Result<Choice, GpuError>) -> String {
    let mut rows =
        vec![["", "NAME", "TYPE", "BACKEND", "DRIVER", "TIER", "USABLE"].map(String::from)];
    rows.extend(reports.iter().enumerate().map(|(index, report)| {
        [
            index.to_string(),
            report.info.name.clone(),
            gpu::device_type(&report.info).to_owned(),
            report.info.backend.to_str().to_owned(),
            gpu::driver(&report.info),
            report.tier.to_string(),
            report
                .unusable
                .as_ref()
                .map_or("yes".to_owned(), |problem| format!("no: {problem}")),
        ]
    }));
    let mut widths = [0; 7];
    for row in &rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = cell.chars().count().max(*width);
        }
    }
    let mut text = String::new();
    for row in &rows {
        let cells: Vec<_> = row
            .iter()
            .zip(widths)
            .map(|(cell, width)| format!("{cell:width$}"))
            .collect();
        text += cells.join("  ").trim_end();
        text.push('\n');
    }
    text += &match choice {
        Ok(choice) => format!("\nused: {} ({})\n", choice.index, choice.reason),
        Err(error @ GpuError::NoAdapter { .. }) => {
            format!("\nused: the CPU (plain Rust, slower), because of: {error}\n")
        }
        Err(_) => "\nused: none\n".to_owned(),
    };
    text
}
