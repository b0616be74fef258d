//! `whereabot info`: a model file's card.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use safetensors::SafeTensors;
use serde_json::Value;

use crate::network::{Activation, Model, Network, Operation, Overlay};

/// Show what a model file holds: layers, sizes, training data, figures
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The model file (safetensors)
    file: PathBuf,
    /// The description in the file, as JSON
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let bytes = std::fs::read(&args.file).with_context(|| args.file.display().to_string())?;
    let model = Model::from_bytes(&bytes, &args.file)?;
    let text = if args.json {
        let (_, header) = SafeTensors::read_metadata(&bytes)?;
        let description = header
            .metadata()
            .as_ref()
            .and_then(|metadata| metadata.get(Model::METADATA_KEY))
            .context("a model without a description")?;
        let description: Value = serde_json::from_str(description)?;
        format!("{description:#}\n")
    } else {
        card(&model, bytes.len())
    };
    super::print(&text)?;
    Ok(ExitCode::SUCCESS)
}

fn card(model: &Model, file_size: usize) -> String {
    let description = &model.description;
    let networks = || model.networks().map(|(_, network)| network);
    let macs = networks().map(Network::macs).sum();
    let parameters: usize = networks().map(Network::parameter_count).sum();
    let overlay = match description.overlay {
        Overlay::Multiply {} => "colour times mask".to_owned(),
        Overlay::Threshold { threshold } => {
            format!("colour where the mask is at least {threshold}")
        }
        Overlay::Ramp { low, high } => {
            format!("colour that fades in from a mask of {low} to one of {high}")
        }
    };
    let coarse = model.coarse().map(|(_, zoom)| zoom);
    let [coarse, zoom] = [coarse, description.zoom].map(|zoom| match zoom {
        None => "none".to_owned(),
        Some(zoom) => format!(
            "{} standard deviations of the mask across the image, {} to {} times",
            zoom.spread, zoom.least, zoom.most
        ),
    });
    let arm = match &description.arm {
        None => "joints stay where the network puts them".to_owned(),
        Some(arm) => {
            let bodies = arm
                .bodies
                .iter()
                .map(|links| format!("{} + {} m", links.upper_arm, links.forearm));
            let bodies: Vec<_> = bodies.collect();
            format!(
                "joints fitted to upper arm + forearm of {}",
                bodies.join(" or ")
            )
        }
    };
    let camera = description.camera;
    let mut text = format!(
        "robot       {}\n\
         family      {}\n\
         joints      {}\n\
         input       {} x {} pixels, fx {} fy {} cx {} cy {}\n\
         mask zoom   {coarse}\n\
         overlay     {overlay}\n\
         joint zoom  {zoom}\n\
         arm         {arm}\n\
         mask        probability of at least {}\n\
         presence    probability of at least {} on {} % of the input\n\
         size        {} MMAC an image, {parameters} parameters, {} KiB\n",
        description.robot,
        description.family,
        description.joints.join(", "),
        description.input.width,
        description.input.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        description.presence.mask_threshold,
        description.presence.sure_threshold,
        rounded_percent(description.presence.min_sure),
        millions(macs),
        file_size / 1024,
    );
    for (name, network) in model.networks() {
        text += &layers(name, network);
    }
    if let Some(entries) = description.card.as_object().filter(|card| !card.is_empty()) {
        text += "\ncard\n";
        for (key, value) in entries {
            outline(&mut text, key, value, 1);
        }
    }
    text
}

fn layers(name: &str, network: &Network) -> String {
    let mut text = format!(
        "\n{name} network: {} to {}, {} MMAC, {} parameters\n",
        network.input(),
        network.output(),
        millions(network.macs()),
        network.parameter_count(),
    );
    for node in network.nodes() {
        let layer = &node.layer;
        let parameters = node
            .parameters
            .as_ref()
            .map_or(0, |p| p.weight.len() + p.bias.len());
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "  {:10} {:13} {:36} of {:16} {:16} {:>9} MMAC {:>9} parameters",
            layer.name,
            layer.operation.name(),
            options(&layer.operation),
            layer.inputs.join(", "),
            node.output.to_string(),
            millions(layer.operation.macs(node.input)),
            parameters,
        );
    }
    text
}

fn options(operation: &Operation) -> String {
    let activation = |activation: &Activation| match activation {
        Activation::None => "",
        Activation::Relu => ", relu",
        Activation::Sigmoid => ", sigmoid",
    };
    match operation {
        Operation::Conv2d {
            kernel,
            dilation,
            activation: a,
            ..
        } => format!("{kernel} x {kernel}, dilation {dilation}{}", activation(a)),
        Operation::MaxPool2d { size } => format!("{size} x {size}"),
        Operation::Dense {
            out_features,
            activation: a,
        } => format!("to {out_features}{}", activation(a)),
        Operation::Upsample2d { scale } => format!("x {scale}"),
        Operation::SoftArgmax2d {
            origin: [x, y],
            step: [dx, dy],
        } => format!("from {x:.3}, {y:.3} by {dx:.3}, {dy:.3}"),
        Operation::Sigmoid | Operation::Concat | Operation::BackProject => String::new(),
    }
}

fn rounded_percent(share: f32) -> String {
    format!("{:.2}", 100.0 * f64::from(share))
}

fn millions(count: u64) -> String {
    format!("{:.2}", count as f64 / 1e6)
}

/// A JSON value as indented `key: value` lines.
fn outline(text: &mut String, key: &str, value: &Value, depth: usize) {
    let indent = "  ".repeat(depth);
    let scalar = |value: &Value| match value {
        Value::String(s) => s.clone(),
        other => other.to_string(),
    };
    // A curve's points stay in one line.
    let nested = |value: &Value| match value {
        Value::Array(items) => items.iter().any(|v| v.is_object() || v.is_array()),
        other => other.is_object(),
    };
    match value {
        Value::Object(entries) => {
            *text += &format!("{indent}{key}:\n");
            for (key, value) in entries {
                outline(text, key, value, depth + 1);
            }
        }
        Value::Array(items) if items.iter().any(nested) => {
            *text += &format!("{indent}{key}:\n");
            for item in items {
                outline(text, "-", item, depth + 1);
            }
        }
        Value::Array(items) => {
            let items: Vec<_> = items.iter().map(scalar).collect();
            *text += &format!("{indent}{key}: {}\n", items.join(", "));
        }
        other => *text += &format!("{indent}{key}: {}\n", scalar(other)),
    }
}
