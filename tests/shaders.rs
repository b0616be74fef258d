//! Every kernel is valid WGSL and translates to every language that a backend speaks.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

use std::collections::BTreeSet;
use std::path::Path;

use naga::back::{PipelineConstants, glsl, hlsl, msl, pipeline_constants, spv};
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use naga::{Module, ShaderStage};

/// One for each file in `shaders/`: a kernel that nobody lists is not tested.
const KERNELS: [&str; 14] = [
    "back_project",
    "concat",
    "conv2d",
    "coverage",
    "dense",
    "max_pool2d",
    "overlay",
    "probe_arithmetic",
    "probe_copy",
    "rectify",
    "render",
    "sigmoid",
    "soft_argmax2d",
    "upsample2d",
];

fn source(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders");
    std::fs::read_to_string(folder.join(format!("{name}.wgsl"))).unwrap()
}

/// Valid, with a number for every constant that the plan would give.
fn resolved(source: &str) -> Result<(Module, ModuleInfo), String> {
    let module = naga::front::wgsl::parse_str(source).map_err(|e| e.emit_to_string(source))?;
    let validate = |module: &Module| {
        Validator::new(ValidationFlags::all(), Capabilities::empty())
            .validate(module)
            .map_err(|e| e.emit_to_string(source))
    };
    let info = validate(&module)?;
    let constants: PipelineConstants = module
        .overrides
        .iter()
        .filter(|(_, o)| o.init.is_none())
        .map(|(_, o)| (o.name.clone().unwrap(), 1.0))
        .collect();
    let (module, info) = pipeline_constants::process_overrides(&module, &info, None, &constants)
        .map(|(module, info)| (module.into_owned(), info.into_owned()))
        .map_err(|e| e.to_string())?;
    Ok((module, info))
}

fn translate(module: &Module, info: &ModuleInfo) -> Result<(), String> {
    let words = spv::write_vec(module, info, &spv::Options::default(), None)
        .map_err(|e| format!("SPIR-V: {e}"))?;
    assert!(!words.is_empty());
    msl::write_string(
        module,
        info,
        &msl::Options {
            fake_missing_bindings: true,
            ..Default::default()
        },
        &msl::PipelineOptions::default(),
    )
    .map_err(|e| format!("MSL: {e}"))?;
    let mut text = String::new();
    let options = hlsl::Options {
        fake_missing_bindings: true,
        ..Default::default()
    };
    hlsl::Writer::new(&mut text, &options, &hlsl::PipelineOptions::default())
        .write(module, info, None)
        .map_err(|e| format!("HLSL: {e}"))?;
    for entry in &module.entry_points {
        let options = glsl::Options {
            version: glsl::Version::new_gles(310),
            ..Default::default()
        };
        let pipeline = glsl::PipelineOptions {
            shader_stage: entry.stage,
            entry_point: entry.name.clone(),
            multiview: None,
        };
        let mut text = String::new();
        glsl::Writer::new(
            &mut text,
            module,
            info,
            &options,
            &pipeline,
            naga::proc::BoundsCheckPolicies::default(),
        )
        .and_then(|mut writer| writer.write())
        .map_err(|e| format!("GLSL, {}: {e}", entry.name))?;
    }
    Ok(())
}

#[test]
fn every_file_is_listed() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders");
    let found: BTreeSet<String> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    let listed: BTreeSet<String> = KERNELS.map(|name| format!("{name}.wgsl")).into();
    assert_eq!(found, listed);
}

#[test]
fn every_kernel_translates_to_every_backend() {
    for name in KERNELS {
        let (module, info) = resolved(&source(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        translate(&module, &info).unwrap_or_else(|e| panic!("{name}: {e}"));
    }
}

#[test]
fn every_kernel_begins_with_its_purpose_and_computes() {
    // The recorder's shader is the only one that draws.
    for name in KERNELS {
        let text = source(name);
        assert!(text.starts_with("// "), "{name}: no purpose");
        let (module, _) = resolved(&text).unwrap();
        let stages: Vec<_> = module.entry_points.iter().map(|e| e.stage).collect();
        assert!(!stages.is_empty(), "{name}: no entry point");
        let computes = stages.iter().all(|&stage| stage == ShaderStage::Compute);
        assert_eq!(computes, name != "render", "{name}");
    }
}

#[test]
fn a_wrong_kernel_is_noticed() {
    let broken = source("conv2d").replace("vec4(0.0)", "vec3(0.0)");
    assert!(resolved(&broken).is_err());
}
