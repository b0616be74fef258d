use super::pipelines::Checks;
use super::tensor::Tensor;
use super::{Device, GpuError, Layout, kernel_text};

/// One dispatch of a kernel: all that encoding it needs, made once.
#[derive(Debug, Clone)]
pub struct Step {
    label: String,
    kernel: &'static str,
    work: Work,
    pipeline: wgpu::ComputePipeline,
    bind_group: wgpu::BindGroup,
    workgroups: [u32; 2],
}

/// What a step has to do, by the shapes of what it reads and writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Work {
    /// Multiply-adds of convolutions and dense layers, two each. Other arithmetic is not counted: it
    /// hides behind its loads and stores.
    pub operations: u64,
    /// Activations read, activations written and parameters, each once.
    pub bytes: u64,
}

impl Work {
    /// Reads or writes each of `tensors` and `parameters` values, and does so many `multiply_adds`.
    pub(super) fn new(tensors: Tensors<'_>, parameters: usize, multiply_adds: u64) -> Self {
        let activations: u64 = tensors.named().map(|(.., tensor)| tensor.bytes()).sum();
        Self {
            operations: 2 * multiply_adds,
            bytes: activations + 4 * parameters as u64,
        }
    }
}

/// What a step is made of.
pub(super) struct StepDescriptor<'a> {
    /// Names the step in profilers and driver messages.
    pub label: &'a str,
    /// The name of the kernel's file in `shaders/`.
    pub kernel: &'static str,
    /// The kernel's WGSL, to stand behind its layout's.
    pub source: &'a str,
    /// Its entry point.
    pub entry_point: &'a str,
    /// What it reads and writes by its layout's functions, all in one layout.
    pub tensors: Tensors<'a>,
    /// Values of its own `override` constants.
    pub constants: &'a [(&'a str, f64)],
    /// Values of the constants that it needs where WGSL has no `override`: sizes of arrays.
    pub sizes: &'a [(&'a str, usize)],
    /// What else it binds, as (binding, resource).
    pub bindings: &'a [(u32, wgpu::BindingResource<'a>)],
    /// Number of workgroups. The kernel works out its index as `y * num_workgroups.x + x`, and
    /// passes over indices beyond its work.
    pub workgroups: usize,
    /// What it has to do.
    pub work: Work,
}

/// The tensors of a kernel: bindings 0, 1 and 2.
#[derive(Clone, Copy, Default)]
pub(super) struct Tensors<'a> {
    pub input: Option<&'a Tensor>,
    pub second: Option<&'a Tensor>,
    pub output: Option<&'a Tensor>,
}

impl<'a> Tensors<'a> {
    pub fn from(input: &'a Tensor) -> Self {
        Self {
            input: Some(input),
            ..Self::default()
        }
    }

    pub fn to(output: &'a Tensor) -> Self {
        Self {
            output: Some(output),
            ..Self::default()
        }
    }

    pub fn from_to(input: &'a Tensor, output: &'a Tensor) -> Self {
        Self {
            output: Some(output),
            ..Self::from(input)
        }
    }

    pub fn both_to(input: &'a Tensor, second: &'a Tensor, output: &'a Tensor) -> Self {
        Self {
            second: Some(second),
            ..Self::from_to(input, output)
        }
    }

    /// Those that there are, by binding and name.
    fn named(self) -> impl Iterator<Item = (u32, &'static str, &'a Tensor)> {
        [
            (0, "INPUT", self.input),
            (1, "SECOND", self.second),
            (2, "OUTPUT", self.output),
        ]
        .into_iter()
        .filter_map(|(binding, name, tensor)| Some((binding, name, tensor?)))
    }

    /// Empty where there are none: the kernel then uses no layout either.
    fn constants(self) -> Vec<(String, f64)> {
        let mut constants = Vec::new();
        for (_, name, tensor) in self.named() {
            let values = [
                ("PLANES", tensor.planes()),
                ("HEIGHT", tensor.shape.height),
                ("WIDTH", tensor.shape.width),
                ("MARGIN", tensor.margin().unwrap_or(0)),
                ("FULL", tensor.is_full().into()),
            ];
            constants.extend(values.map(|(what, v)| (format!("{name}_{what}"), v as f64)));
        }
        if let Some((.., tensor)) = self.named().next() {
            constants.push(("BATCH".into(), tensor.batch as f64));
        }
        constants
    }

    fn layout(self) -> Option<Layout> {
        self.named().map(|(.., tensor)| tensor.layout()).next()
    }
}

impl Step {
    /// Compiles the kernel and binds its resources. Driver errors reach the caller's
    /// [`Device::scoped`].
    pub(super) fn new(device: &Device, step: &StepDescriptor<'_>) -> Result<Self, GpuError> {
        Self::checked(device, step, Checks::Kept)
    }

    /// The same for a kernel that, whatever the numbers in its tensors, stays within what it binds and within its
    /// arrays, writes workgroup memory before it reads it, divides by no zero, and ends: it runs without wgpu's
    /// checks of that.
    pub(super) fn trusted(device: &Device, step: &StepDescriptor<'_>) -> Result<Self, GpuError> {
        Self::checked(device, step, Checks::Left)
    }

    fn checked(
        device: &Device,
        step: &StepDescriptor<'_>,
        checks: Checks,
    ) -> Result<Self, GpuError> {
        let geometry = step.tensors.constants();
        let constants: Vec<(&str, f64)> = geometry
            .iter()
            .map(|(name, value)| (name.as_str(), *value))
            .chain(step.constants.iter().copied())
            .collect();
        let text = kernel_text(step.tensors.layout(), step.sizes, step.source);
        let pipeline = device.pipeline(step.label, text, step.entry_point, &constants, checks)?;
        let bind_group = bind(device, &pipeline, step.tensors, step.bindings);
        // A dimension holds 65,535 workgroups at most: long dispatches are folded into rows.
        let row = device.wgpu().limits().max_compute_workgroups_per_dimension as usize;
        let x = step.workgroups.clamp(1, row);
        let y = step.workgroups.div_ceil(x).max(1);
        device.require(
            &format!("{}: workgroups", step.label),
            step.workgroups as u64,
            (row * row) as u64,
        )?;
        Ok(Self {
            label: step.label.to_owned(),
            kernel: step.kernel,
            work: step.work,
            pipeline,
            bind_group,
            workgroups: [x as u32, y as u32],
        })
    }

    /// A `kernel` of `source` that binds only `tensors`, and makes a texel of the output an invocation,
    /// 64 of them a workgroup.
    pub(super) fn by_texel(
        device: &Device,
        label: &str,
        (kernel, source): (&'static str, &str),
        constants: &[(&str, f64)],
        tensors: Tensors<'_>,
    ) -> Result<Self, GpuError> {
        let texels = tensors.output.map_or(0, Tensor::texels);
        Self::new(
            device,
            &StepDescriptor {
                label,
                kernel,
                source,
                entry_point: "main",
                tensors,
                constants,
                sizes: &[],
                bindings: &[],
                workgroups: texels.div_ceil(64),
                work: Work::new(tensors, 0, 0),
            },
        )
    }

    /// The same, for the layer `label`.
    pub(super) fn labelled(self, label: String) -> Self {
        Self { label, ..self }
    }

    /// The layer that it belongs to, as `network.layer`. A layer's steps follow each other.
    pub fn label(&self) -> &str {
        &self.label
    }

    /// The name of its kernel's file in `shaders/`.
    pub fn kernel(&self) -> &'static str {
        self.kernel
    }

    /// What it has to do.
    pub fn work(&self) -> Work {
        self.work
    }

    /// The same kernel, bound to other resources. Driver errors reach the caller's [`Device::scoped`].
    pub(super) fn rebound(
        &self,
        device: &Device,
        tensors: Tensors<'_>,
        bindings: &[(u32, wgpu::BindingResource<'_>)],
        work: Work,
    ) -> Self {
        Self {
            work,
            bind_group: bind(device, &self.pipeline, tensors, bindings),
            ..self.clone()
        }
    }

    /// Records the dispatch.
    pub fn encode(&self, pass: &mut wgpu::ComputePass<'_>) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.bind_group, &[]);
        let [x, y] = self.workgroups;
        pass.dispatch_workgroups(x, y, 1);
    }
}

fn bind(
    device: &Device,
    pipeline: &wgpu::ComputePipeline,
    tensors: Tensors<'_>,
    bindings: &[(u32, wgpu::BindingResource<'_>)],
) -> wgpu::BindGroup {
    let entries: Vec<_> = tensors
        .named()
        .map(|(binding, _, tensor)| (binding, tensor.resource()))
        .chain(bindings.iter().cloned())
        .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource })
        .collect();
    device.wgpu().create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &entries,
    })
}

/// The number that stands for an activation in the kernels.
pub(super) fn activation_number(activation: crate::network::Activation) -> u32 {
    use crate::network::Activation;
    match activation {
        Activation::None => 0,
        Activation::Relu => 1,
        Activation::Sigmoid => 2,
    }
}
