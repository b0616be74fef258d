//! Every kernel is valid WGSL and translates to every language that a backend speaks; what it becomes
//! compiles, where a compiler runs here.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use naga::back::{PipelineConstants, glsl, hlsl, msl, pipeline_constants, spv};
use naga::valid::{
    Capabilities, ModuleInfo, ShaderStages, SubgroupOperationSet, ValidationFlags, Validator,
};
use naga::{EntryPoint, Module, ShaderStage};

use whereabot::gpu::{Layout, kernel_text};

use Layout::{Buffer, HalfBuffer};

/// What the library composes from the files in `shaders/`, and the constants that these want in their text:
/// a file that nobody lists is not tested. Some have no layout: they bind their textures themselves, or draw.
const KERNELS: [Kernel; 31] = [
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
        &[
            ("WIDE", 32),
            ("ROWS", 2),
            ("STEP", 8),
            ("SPLIT", 2),
            ("SHARE", 1),
            ("WAYS", 2),
            ("SPAN", 1),
            ("SEGMENT", 32),
            ("VALUES_EACH", 1),
            ("WEIGHTS_EACH", 2),
        ],
    ),
    (
        &[
            "conv2d_lattice",
            "conv2d_rows",
            "conv2d_pixels",
            "conv2d_subgroup",
        ],
        &[],
        &[("ROWS", 3), ("KERNEL", 3), ("SUBGROUP", 8)],
    ),
    (
        &[
            "conv2d_lattice",
            "conv2d_rows",
            "conv2d_pooled",
            "conv2d_subgroup",
        ],
        &[],
        &[
            ("ROWS", 4),
            ("KERNEL", 3),
            ("SUBGROUP", 16),
            ("SIZE", 2),
            ("WINDOWS", 2),
        ],
    ),
    (
        &[
            "conv2d_lattice",
            "conv2d_rows",
            "conv2d_pixels",
            "conv2d_texture",
        ],
        &[],
        &[("ROWS", 3), ("KERNEL", 3)],
    ),
    (
        &["conv2d_lattice", "conv2d_subgroup_one"],
        &[],
        &[("ROWS", 3), ("KERNEL", 3)],
    ),
    (
        &["conv2d_planes", "conv2d_one"],
        &[Buffer, HalfBuffer],
        &[("ROWS", 4), ("SIDE", 3)],
    ),
    (
        &["conv2d_planes", "conv2d_tiled"],
        &[Buffer, HalfBuffer],
        &[
            ("PIXELS", 4),
            ("PAIRS", 2),
            ("STEP", 2),
            ("VALUES_EACH", 4),
            ("TAPS_EACH", 1),
        ],
    ),
    (&["coverage"], &Layout::ALL, &[]),
    (&["dense"], &Layout::ALL, &[]),
    (
        &["estimate_layout", "estimate"],
        &Layout::ALL,
        &[("JOINTS", 6)],
    ),
    (&["kinematic_fit"], &Layout::ALL, &[]),
    (&["max_pool2d"], &Layout::ALL, &[]),
    (&["overlay_share", "overlay"], &Layout::ALL, &[]),
    (&["probe_arithmetic"], &[], &[]),
    (&["probe_copy"], &[], &[]),
    (&["gaze", "rectify", "rectify_storage"], &Layout::ALL, &[]),
    (&["gaze", "rectify", "rectify_texture"], &Layout::ALL, &[]),
    (&["gaze", "rectify", "rectify_srgb"], &Layout::ALL, &[]),
    (&["gaze", "rectify", "rectify_nv12"], &Layout::ALL, &[]),
    (&["render"], &[], &[]),
    (&["sigmoid"], &Layout::ALL, &[]),
    (&["soft_argmax2d"], &Layout::ALL, &[]),
    (&["unrectify"], &Layout::ALL, &[]),
    (&["upsample2d"], &Layout::ALL, &[]),
    (
        &["overlay_share", "gaze", "zoom_camera", "zoom"],
        &Layout::ALL,
        &[],
    ),
    (
        &["overlay_share", "gaze", "zoom_camera", "zoom_overlay"],
        &Layout::ALL,
        &[],
    ),
    (&["gaze", "zoom_camera", "zoom_joints"], &Layout::ALL, &[]),
    (&["gaze", "zoom_camera", "zoom_mask"], &Layout::ALL, &[]),
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

/// What a backend compiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Language {
    SpirV,
    Msl,
    Hlsl,
    Glsl,
}

use Language::{Glsl, Hlsl, Msl, SpirV};

/// `entry` in `language`, as text or as SPIR-V's words.
fn translate(
    language: Language,
    module: &Module,
    info: &ModuleInfo,
    entry: &EntryPoint,
) -> Result<Vec<u8>, String> {
    let text = match language {
        SpirV => {
            let options = spv::Options {
                // The first with subgroups.
                lang_version: (1, 3),
                ..Default::default()
            };
            let words = spv::write_vec(module, info, &options, None).map_err(|e| e.to_string())?;
            return Ok(words.into_iter().flat_map(u32::to_le_bytes).collect());
        }
        Msl => {
            let options = msl::Options {
                // The first with matrix units.
                lang_version: (2, 3),
                fake_missing_bindings: true,
                ..Default::default()
            };
            let pipeline = msl::PipelineOptions::default();
            let (text, _) =
                msl::write_string(module, info, &options, &pipeline).map_err(|e| e.to_string())?;
            text
        }
        Hlsl => {
            let mut text = String::new();
            let options = hlsl::Options {
                fake_missing_bindings: true,
                ..Default::default()
            };
            hlsl::Writer::new(&mut text, &options, &hlsl::PipelineOptions::default())
                .write(module, info, None)
                .map_err(|e| e.to_string())?;
            text
        }
        Glsl => {
            let mut text = String::new();
            let options = glsl::Options {
                version: glsl::Version::new_gles(310),
                ..Default::default()
            };
            let pipeline = glsl::PipelineOptions {
                shader_stage: entry.stage,
                entry_point: entry.name.clone(),
                multiview: None,
            };
            let checks = naga::proc::BoundsCheckPolicies::default();
            glsl::Writer::new(&mut text, module, info, &options, &pipeline, checks)
                .and_then(|mut writer| writer.write())
                .map_err(|e| e.to_string())?;
            text
        }
    };
    Ok(text.into_bytes())
}

/// Whether naga refuses to translate: matrix units are in SPIR-V and MSL only, and other backends never
/// list them.
fn untranslatable(name: &str, language: Language) -> bool {
    name.contains("cooperative") && matches!(language, Hlsl | Glsl)
}

/// Holds a translation to a compiler that runs here: Apple's and Microsoft's do not.
///
/// # Errors
/// What the compiler says.
fn compile(language: Language, entry: &EntryPoint, translated: &[u8]) -> Result<(), String> {
    let stage = match entry.stage {
        ShaderStage::Vertex => "vert",
        ShaderStage::Fragment => "frag",
        _ => "comp",
    };
    let hlsl = ["-D", "-V", "--target-env", "vulkan1.1", "-o", "/dev/null"];
    let (program, package, arguments) = match language {
        SpirV => (
            "spirv-val",
            "spirv-tools",
            vec!["--target-env", "vulkan1.1", "-"],
        ),
        Glsl => (
            "glslangValidator",
            "glslang-tools",
            vec!["--stdin", "-S", stage],
        ),
        Hlsl => (
            "glslangValidator",
            "glslang-tools",
            [&["--stdin", "-S", stage, "-e", &entry.name], &hlsl[..]].concat(),
        ),
        Msl => panic!("no compiler for MSL runs here"),
    };
    let mut compiler = Command::new(program)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap_or_else(|e| {
            panic!("{program}: {e}: install {package}, as `scripts/install --tests` does")
        });
    let text = match language {
        Hlsl => without_cleared_arrays(std::str::from_utf8(translated).unwrap()).into_bytes(),
        _ => translated.to_vec(),
    };
    // A compiler that ends before it has read all says why.
    let _ = compiler.stdin.take().unwrap().write_all(&text);
    let output = compiler.wait_with_output().unwrap();
    if output.status.success() {
        return Ok(());
    }
    let said = [output.stdout, output.stderr].concat();
    Err(String::from_utf8_lossy(&said).into_owned())
}

/// HLSL without the values of arrays that naga clears by a cast of 0: Microsoft's compilers have that cast,
/// glslang has not, and reads nothing behind it.
fn without_cleared_arrays(text: &str) -> String {
    let mut left = String::new();
    let mut rest = text;
    while let Some((before, behind)) = rest.split_once("])0;") {
        let (before, array) = before.rsplit_once('(').unwrap();
        let (of, sizes) = array.split_once('[').unwrap();
        if let Some(variable) = before.strip_suffix(" = ") {
            left.extend([variable, ";"]);
        } else if let Some(before) = before.strip_suffix("return ") {
            left.push_str(&format!("{before}{of} zeros[{sizes}]; return zeros;"));
        } else {
            panic!("`({array}])0` is neither assigned nor returned: {before}");
        }
        rest = behind;
    }
    left + rest
}

/// What a compiler here says to a kernel that the backends' own compilers accept.
fn refusal(name: &str, language: Language) -> Option<&'static str> {
    let is = |kernel: &str| name.contains(&format!("\"{kernel}\""));
    match language {
        // Debian 12's spirv-tools are older than SPIR-V's matrix units.
        SpirV if is("conv2d_cooperative") => Some("Invalid capability operand: 6022"),
        _ => None,
    }
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
        for entry in &module.entry_points {
            for language in [SpirV, Msl, Hlsl, Glsl] {
                let translated = translate(language, &module, &info, entry);
                assert_eq!(
                    translated.is_err(),
                    untranslatable(&name, language),
                    "{name}, {language:?}: {translated:?}"
                );
            }
        }
    }
}

#[test]
fn every_translation_compiles() {
    for (name, text) in compositions() {
        let (module, info) = resolved(&text).unwrap();
        for entry in &module.entry_points {
            for language in [SpirV, Hlsl, Glsl] {
                if untranslatable(&name, language) {
                    continue;
                }
                let translated = translate(language, &module, &info, entry).unwrap();
                let what = format!("{name}, {}, {language:?}", entry.name);
                match (
                    compile(language, entry, &translated),
                    refusal(&name, language),
                ) {
                    (Ok(()), None) => {}
                    (Ok(()), Some(_)) => panic!("{what}: compiles now: expect no refusal"),
                    (Err(said), refusal) => {
                        let known = refusal.is_some_and(|refusal| said.contains(refusal));
                        assert!(known, "{what}: {said}");
                    }
                }
            }
        }
    }
}

#[test]
fn a_wrong_translation_is_noticed() {
    let (module, info) = resolved(&kernel_text(Some(Buffer), &[], &source("sigmoid"))).unwrap();
    let entry = &module.entry_points[0];
    for language in [SpirV, Hlsl, Glsl] {
        let mut translated = translate(language, &module, &info, entry).unwrap();
        compile(language, entry, &translated).unwrap();
        // A word or the last brace less.
        translated.truncate(translated.len() - 4);
        compile(language, entry, &translated).unwrap_err();
    }
}

#[test]
fn what_stands_behind_a_cleared_array_is_compiled() {
    // Variables of a function, values of one, workgroup memory.
    for (files, cleared) in [
        (&["conv2d_planes", "conv2d_buffer"][..], " = (float4["),
        (&["conv2d_planes", "conv2d_buffer"], "return (bool["),
        (&["dense"], "    sums = (float["),
    ] {
        let own: String = files.iter().map(|file| source(file)).collect();
        let (module, info) = resolved(&kernel_text(Some(Buffer), &[], &own)).unwrap();
        let entry = &module.entry_points[0];
        let text = String::from_utf8(translate(Hlsl, &module, &info, entry).unwrap()).unwrap();
        compile(Hlsl, entry, text.as_bytes()).unwrap();
        let (before, behind) = text.split_once(cleared).unwrap();
        let behind = behind.replacen("])0;", "])0; undeclared();", 1);
        let wrong = [before, &behind].join(cleared);
        let said = compile(Hlsl, entry, wrong.as_bytes()).unwrap_err();
        assert!(said.contains("undeclared"), "{cleared}: {said}");
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
