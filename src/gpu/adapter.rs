use wgpu::{AdapterInfo, Backend, Backends, DeviceType};

use super::{GpuError, Tier};

/// Which adapter is wanted. A flag goes before the environment, the environment before the rule
/// (the best real GPU).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AdapterRequest {
    /// Index in [`list_adapters`], or a part of the adapter's name in any case; a number that is no index, a whole word of it.
    pub adapter: Option<Wanted>,
    /// Backends to search; all when `None`.
    pub backends: Option<Wanted>,
}

/// A wish, and who has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wanted {
    value: String,
    origin: &'static str,
}

impl AdapterRequest {
    /// Reads `WGPU_ADAPTER_NAME` and `WGPU_BACKEND` for what the flags leave open.
    pub fn new(adapter_flag: Option<&str>, backend_flag: Option<&str>) -> Self {
        let wanted = |flag: Option<&str>, flag_name, variable: &'static str| {
            let from = |value: &str, origin| Wanted {
                value: value.trim().to_owned(),
                origin,
            };
            flag.map(|value| from(value, flag_name)).or_else(|| {
                std::env::var(variable)
                    .ok()
                    .filter(|value| !value.trim().is_empty())
                    .map(|value| from(&value, variable))
            })
        };
        Self {
            adapter: wanted(adapter_flag, "--adapter", "WGPU_ADAPTER_NAME"),
            backends: wanted(backend_flag, "--backend", "WGPU_BACKEND"),
        }
    }

    /// The backends to search.
    ///
    /// # Errors
    /// [`GpuError::UnknownBackend`].
    pub(super) fn backends(&self) -> Result<Backends, GpuError> {
        let Some(wanted) = &self.backends else {
            return Ok(Backends::PRIMARY | Backends::SECONDARY);
        };
        wanted
            .value
            .split(',')
            .map(|name| match name.trim().to_lowercase().as_str() {
                "vulkan" | "vk" => Ok(Backends::VULKAN),
                "metal" | "mtl" => Ok(Backends::METAL),
                "dx12" | "d3d12" => Ok(Backends::DX12),
                "gl" | "gles" | "opengl" => Ok(Backends::GL),
                _ => Err(GpuError::UnknownBackend {
                    wanted: name.trim().to_owned(),
                    origin: wanted.origin,
                }),
            })
            .try_fold(Backends::empty(), |all, one| Ok(all | one?))
    }
}

/// An adapter as `whereabot adapters` shows it.
#[derive(Debug, Clone)]
pub struct AdapterReport {
    /// Name, type, backend and driver.
    pub info: AdapterInfo,
    /// What its kernels can use.
    pub tier: Tier,
    /// Why it cannot be used, if it cannot.
    pub unusable: Option<String>,
}

impl AdapterReport {
    fn of(adapter: &wgpu::Adapter) -> Self {
        let limits = adapter.limits();
        let compute = adapter
            .get_downlevel_capabilities()
            .flags
            .contains(wgpu::DownlevelFlags::COMPUTE_SHADERS);
        let short = needs(&limits).find(|(_, needed, allowed)| allowed < needed);
        let unusable = match short {
            _ if !compute => Some("no compute shaders".to_owned()),
            Some((what, needed, allowed)) => Some(format!("{allowed} {what}, {needed} needed")),
            None => None,
        };
        Self {
            info: adapter.get_info(),
            tier: Tier::of(adapter),
            unusable,
        }
    }
}

/// What every kernel counts on, of what WebGPU guarantees: name, how much is needed, and how much of
/// `limits` there is.
pub(super) fn needs(limits: &wgpu::Limits) -> impl Iterator<Item = (&'static str, u32, u32)> {
    let least = wgpu::Limits::defaults();
    [
        (
            "storage buffers a shader",
            4,
            limits.max_storage_buffers_per_shader_stage,
        ),
        (
            "storage textures a shader",
            4,
            limits.max_storage_textures_per_shader_stage,
        ),
        (
            "invocations a workgroup",
            least.max_compute_invocations_per_workgroup,
            limits.max_compute_invocations_per_workgroup,
        ),
        (
            "bytes of workgroup memory",
            least.max_compute_workgroup_storage_size,
            limits.max_compute_workgroup_storage_size,
        ),
    ]
    .into_iter()
}

/// Which adapter is used, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Choice {
    /// Index in [`list_adapters`].
    pub index: usize,
    /// The reason, for people.
    pub reason: String,
}

/// All adapters of the backends asked for, and the one that would be used (or why there is none).
///
/// # Errors
/// [`GpuError::UnknownBackend`].
#[allow(clippy::type_complexity)]
#[cfg(not(target_arch = "wasm32"))]
pub fn list_adapters(
    request: &AdapterRequest,
) -> Result<(Vec<AdapterReport>, Result<Choice, GpuError>), GpuError> {
    let adapters = pollster::block_on(enumerate(request.backends()?));
    let reports: Vec<_> = adapters.iter().map(AdapterReport::of).collect();
    let choice = choose(&reports, request);
    Ok((reports, choice))
}

/// The adapter that `request` leads to.
pub(super) async fn open(request: &AdapterRequest) -> Result<(wgpu::Adapter, Choice), GpuError> {
    // Without a wish, GL is looked at only where it may have something better: opening it is slow, and
    // noisy on a machine without a display.
    let (first, last) = if *request == AdapterRequest::default() {
        (Backends::PRIMARY, Backends::SECONDARY)
    } else {
        (request.backends()?, Backends::empty())
    };
    let mut adapters = enumerate(first).await;
    let settles = |report: AdapterReport| report.unusable.is_none() && outranks_gl(&report.info);
    if !last.is_empty() && !adapters.iter().map(AdapterReport::of).any(settles) {
        adapters.extend(enumerate(last).await);
    }
    let reports: Vec<_> = adapters.iter().map(AdapterReport::of).collect();
    let choice = choose(&reports, request)?;
    Ok((adapters.swap_remove(choice.index), choice))
}

async fn enumerate(backends: Backends) -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    instance.enumerate_adapters(backends).await
}

fn choose(reports: &[AdapterReport], request: &AdapterRequest) -> Result<Choice, GpuError> {
    let backends = || match &request.backends {
        Some(wanted) => wanted.value.clone(),
        None => "all".into(),
    };
    let Some(wanted) = &request.adapter else {
        return reports
            .iter()
            .enumerate()
            .filter(|(_, report)| report.unusable.is_none())
            // The first of the best: `max_by_key` would give the last.
            .min_by_key(|(_, report)| std::cmp::Reverse(rank(&report.info)))
            .map(|(index, report)| Choice {
                index,
                reason: format!(
                    "best of {} found: {}",
                    reports.len(),
                    as_reason(report.info.device_type)
                ),
            })
            .ok_or_else(|| GpuError::NoAdapter {
                backends: backends(),
            });
    };
    let reason = format!("{} = {}", wanted.origin, wanted.value);
    let name = wanted.value.to_lowercase();
    let by_index = name.parse().ok().filter(|&index| index < reports.len());
    let is_named = |report: &AdapterReport| is_in(&report.info.name.to_lowercase(), &name);
    // A card has an adapter a backend, not each of which may be usable.
    let by_name = || {
        let usable = |report: &AdapterReport| is_named(report) && report.unusable.is_none();
        let first = reports.iter().position(usable);
        first.or_else(|| reports.iter().position(is_named))
    };
    let unknown = || GpuError::UnknownAdapter {
        wanted: wanted.value.clone(),
        origin: wanted.origin,
        available: reports
            .iter()
            .enumerate()
            .map(|(i, report)| format!("{i}: {} ({})", report.info.name, report.info.backend))
            .collect(),
    };
    let index = by_index.or_else(by_name).ok_or_else(unknown)?;
    match reports.get(index).map(|report| &report.unusable) {
        Some(Some(problem)) => Err(GpuError::Request {
            adapter: wanted.value.clone(),
            reason: problem.clone(),
        }),
        _ => Ok(Choice { index, reason }),
    }
}

/// Whether `wanted` is in `name`, both in lower case. Names are full of digits: a number must be a word of its own.
fn is_in(name: &str, wanted: &str) -> bool {
    if wanted.parse::<u64>().is_err() {
        return name.contains(wanted);
    }
    let is_apart = |c: char| !(c.is_alphanumeric() || c == '.');
    name.split(is_apart).any(|word| word == wanted)
}

/// What kind of device an adapter is, such as `discrete GPU`.
pub fn device_type(info: &AdapterInfo) -> &'static str {
    match info.device_type {
        DeviceType::DiscreteGpu => "discrete GPU",
        DeviceType::IntegratedGpu => "integrated GPU",
        DeviceType::VirtualGpu => "virtual GPU",
        DeviceType::Cpu => "CPU",
        DeviceType::Other => "other",
    }
}

/// The driver's name and version.
pub fn driver(info: &AdapterInfo) -> String {
    format!("{} {}", info.driver, info.driver_info)
        .trim()
        .to_owned()
}

/// Real GPUs first, and of those native backends before GL, whatever kind of GPU they say they have: so GL need not be
/// opened to know that it has nothing better.
fn rank(info: &AdapterInfo) -> (bool, u8, u8) {
    let kind = match info.device_type {
        DeviceType::DiscreteGpu => 4,
        DeviceType::IntegratedGpu => 3,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 1,
        DeviceType::Cpu => 0,
    };
    let backend = match info.backend {
        Backend::Vulkan | Backend::Metal | Backend::Dx12 => 2,
        Backend::BrowserWebGpu => 1,
        _ => 0,
    };
    (kind > 0, backend, kind)
}

/// Whether an adapter is better than any that GL can have.
fn outranks_gl(info: &AdapterInfo) -> bool {
    rank(info) > rank(&AdapterInfo::new(DeviceType::DiscreteGpu, Backend::Gl))
}

fn as_reason(kind: DeviceType) -> &'static str {
    match kind {
        DeviceType::DiscreteGpu => "a discrete GPU",
        DeviceType::IntegratedGpu => "an integrated GPU",
        DeviceType::VirtualGpu => "a virtual GPU",
        DeviceType::Cpu => "a CPU rasteriser",
        DeviceType::Other => "of unknown type",
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn report(name: &str, device_type: DeviceType, backend: Backend) -> AdapterReport {
        AdapterReport {
            info: AdapterInfo {
                name: name.into(),
                ..AdapterInfo::new(device_type, backend)
            },
            tier: Tier::Baseline,
            unusable: None,
        }
    }

    const LLVMPIPE: &str = "llvmpipe (LLVM 15.0.6, 256 bits)";

    fn three() -> Vec<AdapterReport> {
        vec![
            report(LLVMPIPE, DeviceType::Cpu, Backend::Vulkan),
            report("Card", DeviceType::DiscreteGpu, Backend::Gl),
            report("Card", DeviceType::DiscreteGpu, Backend::Vulkan),
        ]
    }

    fn wants(adapter: &str) -> AdapterRequest {
        AdapterRequest {
            adapter: Some(Wanted {
                value: adapter.into(),
                origin: "--adapter",
            }),
            backends: None,
        }
    }

    fn chosen(reports: &[AdapterReport], request: &AdapterRequest) -> Option<usize> {
        choose(reports, request).ok().map(|choice| choice.index)
    }

    #[test]
    fn the_best_real_gpu_is_chosen_on_its_native_backend() {
        assert_eq!(chosen(&three(), &AdapterRequest::default()), Some(2));
    }

    const KINDS: [DeviceType; 5] = [
        DeviceType::DiscreteGpu,
        DeviceType::IntegratedGpu,
        DeviceType::VirtualGpu,
        DeviceType::Other,
        DeviceType::Cpu,
    ];

    #[test]
    fn whether_gl_is_looked_at_changes_nothing() {
        let request = AdapterRequest::default();
        let mut looked_at = 0;
        for native in KINDS {
            let native = report("native", native, Backend::Vulkan);
            for gl in KINDS {
                let gl = report("gl", gl, Backend::Gl);
                let all = chosen(&[native.clone(), gl], &request);
                if outranks_gl(&native.info) {
                    assert_eq!(all, Some(0), "{:?}", native.info.device_type);
                } else {
                    looked_at += usize::from(all == Some(1));
                }
            }
        }
        // Negative control: where GL has a real GPU beside a CPU rasteriser, it does change something.
        assert_eq!(looked_at, 4);
    }

    #[test]
    fn a_cpu_rasteriser_gives_way_to_a_real_gpu_on_gl_and_to_nothing_else_there() {
        let lavapipe = report(LLVMPIPE, DeviceType::Cpu, Backend::Vulkan);
        assert!(!outranks_gl(&lavapipe.info));
        for kind in KINDS {
            let gl = report("gl", kind, Backend::Gl);
            let expected = usize::from(kind != DeviceType::Cpu);
            let reports = [lavapipe.clone(), gl];
            let found = chosen(&reports, &AdapterRequest::default());
            assert_eq!(found, Some(expected), "{kind:?}");
        }
    }

    #[test]
    fn an_unusable_adapter_is_passed_over() {
        let mut reports = three();
        reports[2].unusable = Some("no compute shaders".into());
        assert_eq!(chosen(&reports, &AdapterRequest::default()), Some(1));
    }

    #[test]
    fn a_name_in_any_case_or_an_index_is_found() {
        assert_eq!(chosen(&three(), &wants("LLVM")), Some(0));
        assert_eq!(chosen(&three(), &wants("1")), Some(1));
    }

    #[test]
    fn of_a_name_the_first_usable_adapter_is_found() {
        let mut reports = three();
        assert_eq!(chosen(&reports, &wants("card")), Some(1));
        reports[1].unusable = Some("no compute shaders".into());
        assert_eq!(chosen(&reports, &wants("card")), Some(2));
        // Where none is, the error says why not.
        reports[2].unusable = Some("too few buffers".into());
        let error = choose(&reports, &wants("card")).unwrap_err().to_string();
        assert!(error.contains("no compute shaders"), "{error}");
    }

    #[test]
    fn an_unknown_name_lists_what_there_is() {
        let error = choose(&three(), &wants("radeon")).unwrap_err().to_string();
        assert!(error.contains("radeon") && error.contains("--adapter"));
        assert!(
            error.contains(&format!("0: {LLVMPIPE} (vulkan)")),
            "{error}"
        );
    }

    #[test]
    fn an_index_beyond_the_list_is_unknown() {
        // Each is in the name of the first adapter, but for the first.
        for index in ["3", "5", "6", "15", "25", "56"] {
            let found = choose(&three(), &wants(index));
            assert!(
                matches!(found, Err(GpuError::UnknownAdapter { .. })),
                "{index}: {found:?}"
            );
        }
    }

    #[test]
    fn a_number_that_is_a_word_of_a_name_is_found() {
        let mut reports = three();
        reports[1].info.name = "GeForce GTX 1080".into();
        reports[2].info.name = "GeForce RTX 3080 Ti".into();
        assert_eq!(chosen(&reports, &wants("1080")), Some(1));
        assert_eq!(chosen(&reports, &wants("3080")), Some(2));
        assert_eq!(chosen(&reports, &wants("256")), Some(0));
        // Negative control: a part of a word. With a letter it is found all the same.
        assert_eq!(chosen(&reports, &wants("080")), None);
        assert_eq!(chosen(&reports, &wants("x 30")), Some(2));
    }

    #[test]
    fn no_adapter_is_an_error() {
        assert!(matches!(
            choose(&[], &AdapterRequest::default()),
            Err(GpuError::NoAdapter { .. })
        ));
    }

    #[test]
    fn an_unknown_backend_is_an_error() {
        let request = AdapterRequest {
            adapter: None,
            backends: Some(Wanted {
                value: "vulkan,glide".into(),
                origin: "--backend",
            }),
        };
        assert!(matches!(
            request.backends(),
            Err(GpuError::UnknownBackend { wanted, .. }) if wanted == "glide"
        ));
    }
}
