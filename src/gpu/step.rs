use super::tensor::Tensor;
use super::{Device, GpuError};

/// One dispatch of a kernel: all that encoding it needs, made once.
#[derive(Debug)]
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
    /// Reads `inputs` and `parameters` values, does `macs` multiply-adds an image, writes `output`.
    pub(super) fn new(inputs: &[&Tensor], parameters: usize, macs: usize, output: &Tensor) -> Self {
        let activations: u64 = inputs.iter().map(|input| input.bytes()).sum();
        Self {
            operations: 2 * (output.batch * macs) as u64,
            bytes: activations + (4 * parameters) as u64 + output.bytes(),
        }
    }
}

/// What a step is made of.
pub(super) struct StepDescriptor<'a> {
    /// Names the step in profilers and driver messages.
    pub label: &'a str,
    /// The name of the kernel's file in `shaders/`.
    pub kernel: &'static str,
    /// The kernel's WGSL.
    pub source: &'a str,
    /// Its entry point.
    pub entry_point: &'a str,
    /// Values of its `override` constants.
    pub constants: &'a [(&'a str, f64)],
    /// What it binds, as (binding, resource).
    pub bindings: &'a [(u32, wgpu::BindingResource<'a>)],
    /// Number of workgroups. The kernel works out its index as `y * num_workgroups.x + x`, and
    /// passes over indices beyond its work.
    pub workgroups: usize,
    /// What it has to do.
    pub work: Work,
}

impl Step {
    /// Compiles the kernel and binds its resources. Driver errors reach the caller's
    /// [`Device::scoped`].
    pub(super) fn new(device: &Device, step: &StepDescriptor<'_>) -> Result<Self, GpuError> {
        let module = device
            .wgpu()
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(step.label),
                source: wgpu::ShaderSource::Wgsl(step.source.into()),
            });
        let pipeline = device
            .wgpu()
            .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(step.label),
                layout: None,
                module: &module,
                entry_point: Some(step.entry_point),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: step.constants,
                    ..Default::default()
                },
                cache: None,
            });
        let bind_group = bind(device, &pipeline, step.bindings);
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

    /// A kernel that reads one tensor (binding 0) and writes another (binding 1), 64 of its
    /// `invocations` a workgroup.
    pub(super) fn from_to(
        device: &Device,
        label: &str,
        (kernel, source): (&'static str, &str),
        constants: &[(&str, f64)],
        (input, output): (&Tensor, &Tensor),
        invocations: usize,
    ) -> Result<Self, GpuError> {
        Self::new(
            device,
            &StepDescriptor {
                label,
                kernel,
                source,
                entry_point: "main",
                constants,
                bindings: &[
                    (0, input.buffer.as_entire_binding()),
                    (1, output.buffer.as_entire_binding()),
                ],
                workgroups: invocations.div_ceil(64),
                work: Work::new(&[input], 0, 0, output),
            },
        )
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

    /// Binds other resources to the same kernel.
    pub(super) fn rebind(
        &mut self,
        device: &Device,
        bindings: &[(u32, wgpu::BindingResource<'_>)],
        work: Work,
    ) {
        self.work = work;
        self.bind_group = bind(device, &self.pipeline, bindings);
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
    bindings: &[(u32, wgpu::BindingResource<'_>)],
) -> wgpu::BindGroup {
    let entries: Vec<_> = bindings
        .iter()
        .map(|(binding, resource)| wgpu::BindGroupEntry {
            binding: *binding,
            resource: resource.clone(),
        })
        .collect();
    device.wgpu().create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &entries,
    })
}

/// The number that stands for an activation in the kernels' `ACTIVATION` constant.
pub(super) fn activation_constant(activation: crate::network::Activation) -> f64 {
    use crate::network::Activation;
    match activation {
        Activation::None => 0.0,
        Activation::Relu => 1.0,
        Activation::Sigmoid => 2.0,
    }
}
