//! Every kernel is valid WGSL and translates to every language that a backend speaks.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

use std::collections::BTreeSet;
use std::path::Path;

use naga::back::{PipelineConstants, glsl, hlsl, msl, pipeline_constants, spv};
use naga::valid::{
    Capabilities, ModuleInfo, ShaderStages, SubgroupOperationSet, ValidationFlags, Validator,
};
use naga::{Module, ShaderStage};

use whereabot::gpu::{Layout, kernel_text};

use Layout::{Buffer, HalfBuffer};

/// What the library composes from the files in `shaders/`, and the constants that these want in their text:
/// a file that nobody lists is not tested. Some have no layout: they bind their textures themselves, or draw.
const KERNELS: [Kernel; 24] = [
    (&["back_project"], &Layout::ALL, &[]),
    (&["concat"], &Layout::ALL, &[]),
    (
        &["conv2d_planes", "conv2d_buffer"],
        &[Buffer, HalfBuffer],
        &[],
    ),
    (
        &["conv2d_cooperative", "conv2d_planes", "conv2d_matrix"],
        &[HalfBuffer],
        &[("STEP", 4)],
    ),
    (
        &["conv2d_lattice", "conv2d_rows", "conv2d_subgroup"],
        &[],
        &[("ROWS", 3), ("KERNEL", 3)],
    ),
    (
        &["conv2d_lattice", "conv2d_rows", "conv2d_texture"],
        &[],
        &[("ROWS", 3), ("KERNEL", 3)],
    ),
    (
        &["conv2d_lattice", "conv2d_subgroup_one"],
        &[],
        &[("ROWS", 3), ("KERNEL", 3)],
    ),
    (
        &["conv2d_planes", "conv2d_tiled"],
        &[Buffer, HalfBuffer],
        &[("PIXELS", 4), ("PAIRS", 2), ("STEP", 2), ("STAGED", 4)],
    ),
    (&["coverage"], &Layout::ALL, &[]),
    (&["dense"], &Layout::ALL, &[]),
    (
        &["estimate_layout", "estimate"],
        &Layout::ALL,
        &[("JOINTS", 6)],
    ),
    (&["max_pool2d"], &Layout::ALL, &[]),
    (&["overlay"], &Layout::ALL, &[]),
    (&["probe_arithmetic"], &[], &[]),
    (&["probe_copy"], &[], &[]),
    (&["rectify", "rectify_storage"], &Layout::ALL, &[]),
    (&["rectify", "rectify_texture"], &Layout::ALL, &[]),
    (&["rectify", "rectify_srgb"], &Layout::ALL, &[]),
    (&["rectify", "rectify_nv12"], &Layout::ALL, &[]),
    (&["render"], &[], &[]),
    (&["sigmoid"], &Layout::ALL, &[]),
    (&["soft_argmax2d"], &Layout::ALL, &[]),
    (&["unrectify"], &Layout::ALL, &[]),
    (&["upsample2d"], &Layout::ALL, &[]),
];

type Kernel = (
    &'static [&'static str],
    &'static [Layout],
    &'static [(&'static str, usize)],
);

fn source(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders");
    std::fs::read_to_string(folder.join(format!("{name}.wgsl"))).unwrap()
}

/// Every whole text of every kernel, with its name.
fn compositions() -> Vec<(String, String)> {
    let mut all = Vec::new();
    for (files, layouts, sizes) in KERNELS {
        let own: String = files.iter().map(|file| source(file)).collect();
        for layout in layouts.iter().copied() {
            let name = format!("{files:?}, {layout:?}");
            all.push((name, kernel_text(Some(layout), sizes, &own)));
        }
        if layouts.is_empty() {
            all.push((format!("{files:?}"), kernel_text(None, sizes, &own)));
        }
    }
    all
}

/// Valid, with a number for every constant that the plan would give.
fn resolved(source: &str) -> Result<(Module, ModuleInfo), String> {
    let module = naga::front::wgsl::parse_str(source).map_err(|e| e.emit_to_string(source))?;
    let capabilities = Capabilities::SUBGROUP
        | Capabilities::SHADER_FLOAT16
        | Capabilities::SHADER_FLOAT16_IN_FLOAT32
        | Capabilities::COOPERATIVE_MATRIX;
    let validate = |module: &Module| {
        Validator::new(ValidationFlags::all(), capabilities)
            .subgroup_stages(ShaderStages::COMPUTE)
            .subgroup_operations(SubgroupOperationSet::all())
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
            // The first with matrix units.
            lang_version: (2, 3),
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
        .filter(|name| name != "layout")
        .collect();
    let listed: BTreeSet<String> = KERNELS
        .iter()
        .flat_map(|(files, ..)| files.iter().map(|name| format!("{name}.wgsl")))
        .collect();
    assert_eq!(found, listed);
}

#[test]
fn every_kernel_translates_to_every_backend() {
    for (name, text) in compositions() {
        let (module, info) = resolved(&text).unwrap_or_else(|e| panic!("{name}: {e}"));
        let translated = translate(&module, &info);
        if name.contains("cooperative") {
            // The only ones that have matrix units; other backends never list them.
            let error = translated.unwrap_err();
            assert!(error.starts_with("HLSL"), "{error}");
        } else {
            translated.unwrap_or_else(|e| panic!("{name}: {e}"));
        }
    }
}

#[test]
fn every_kernel_begins_with_its_purpose() {
    for name in KERNELS.iter().flat_map(|(files, ..)| *files) {
        assert!(source(name).starts_with("// "), "{name}: no purpose");
    }
}

#[test]
fn every_kernel_computes() {
    // The recorder's shader is the only one that draws.
    for (name, text) in compositions() {
        let (module, _) = resolved(&text).unwrap();
        let stages: Vec<_> = module.entry_points.iter().map(|e| e.stage).collect();
        assert!(!stages.is_empty(), "{name}: no entry point");
        let computes = stages.iter().all(|&stage| stage == ShaderStage::Compute);
        assert_eq!(computes, !name.contains("render"), "{name}");
    }
}

#[test]
fn a_wrong_kernel_is_noticed() {
    let right = kernel_text(
        Some(Buffer),
        &[],
        &(source("conv2d_planes") + &source("conv2d_buffer")),
    );
    resolved(&right).unwrap();
    assert!(resolved(&right.replace("vec4(0.0)", "vec3(0.0)")).is_err());
}
