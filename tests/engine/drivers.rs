//! In what the drivers of `scripts/drivers` are known to differ. Each difference is expected, with its reason,
//! where it is known, and nowhere else: a test fails when one goes away.

use crate::common::{Driver, device, driver, on_gpu, on_reference, one_layer};
use whereabot::gpu::{Conv2dKernel, Tier};
use whereabot::network::{Operation, Shape};

#[test]
fn the_driver_is_the_one_that_was_asked_for() {
    if let Ok(wanted) = std::env::var("WHEREABOT_DRIVER") {
        let found = driver().map(|driver| format!("{driver:?}").to_lowercase());
        assert_eq!(
            found.as_deref(),
            Some(wanted.as_str()),
            "{:?}",
            device().info()
        );
    }
}

#[test]
fn what_each_driver_can_run_is_known() {
    let Some(driver) = driver() else {
        println!("nothing is known of {:?}", device().info());
        return;
    };
    let (tier, subgroups, lacking) = match driver {
        Driver::Lavapipe => (Tier::Subgroups, Some(8), 3),
        // Its subgroups are as wide as SSE's registers, and it has no 16-bit floats.
        Driver::SwiftShader => (Tier::Baseline, Some(4), 5),
        // wgpu's GL backend has neither.
        Driver::Gl => (Tier::Baseline, None, 5),
    };
    assert_eq!(device().tier(), tier);
    assert_eq!(device().subgroup_size(), subgroups);
    let lacks = |kernel: &Conv2dKernel| kernel.lacks(&device()).is_some();
    assert_eq!(
        Conv2dKernel::ALL
            .iter()
            .filter(|&kernel| lacks(kernel))
            .count(),
        lacking
    );
}

/// What a kernel leaves in the layers of a texture of `[width, height, layers]` when it writes their numbers,
/// from 1 on, through a view of those from `first` on; -1 where a layer has more than one number.
fn written([width, height, layers]: [u32; 3], first: u32) -> Vec<f32> {
    let device = device();
    let wgpu = device.wgpu();
    let texture = wgpu.create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d {
            width,
            height,
            depth_or_array_layers: layers,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::R32Float,
        usage: wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let view = texture.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2Array),
        base_array_layer: first,
        ..Default::default()
    });
    let module = wgpu.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl(
            "@group(0) @binding(0) var output: texture_storage_2d_array<r32float, write>;
            @compute @workgroup_size(1)
            fn main(@builtin(workgroup_id) at: vec3<u32>) {
                textureStore(output, at.xy, at.z, vec4(f32(at.z + 1u)));
            }"
            .into(),
        ),
    });
    let pipeline = wgpu.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: None,
        layout: None,
        module: &module,
        entry_point: None,
        compilation_options: Default::default(),
        cache: None,
    });
    let bindings = wgpu.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[wgpu::BindGroupEntry {
            binding: 0,
            resource: wgpu::BindingResource::TextureView(&view),
        }],
    });
    let row = (4 * width).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let readback = wgpu.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: u64::from(row * height * layers),
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let mut encoder = wgpu.create_command_encoder(&Default::default());
    let mut pass = encoder.begin_compute_pass(&Default::default());
    pass.set_pipeline(&pipeline);
    pass.set_bind_group(0, &bindings, &[]);
    pass.dispatch_workgroups(width, height, layers - first);
    drop(pass);
    let layout = wgpu::TexelCopyBufferLayout {
        offset: 0,
        bytes_per_row: Some(row),
        rows_per_image: Some(height),
    };
    let copy = wgpu::TexelCopyBufferInfo {
        buffer: &readback,
        layout,
    };
    encoder.copy_texture_to_buffer(texture.as_image_copy(), copy, texture.size());
    device.queue().submit([encoder.finish()]);
    device
        .read(&readback, |bytes| {
            let layers = bytes.chunks_exact((row * height) as usize);
            let number = |layer: &[u8]| {
                let rows = layer.chunks_exact(row as usize);
                let mut texels = rows.flat_map(|row| row[..4 * width as usize].as_chunks().0);
                let first = texels.next().unwrap();
                if texels.all(|texel| texel == first) {
                    f32::from_le_bytes(*first)
                } else {
                    -1.0
                }
            };
            layers.map(number).collect()
        })
        .unwrap()
}

#[test]
fn layers_of_a_texture_are_written_where_they_are() {
    assert_eq!(written([5, 7, 4], 0), [1.0, 2.0, 3.0, 4.0]);
    assert_eq!(written([7, 7, 5], 0), [1.0, 2.0, 3.0, 4.0, 5.0]);
}

#[test]
fn gl_takes_six_square_layers_for_a_cube() {
    // wgpu's GL backend knows a texture's kind by its size alone. `gpu::Tensor` has no such texture.
    let right = written([7, 7, 6], 0) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
    assert_eq!(right, driver() != Some(Driver::Gl));
}

#[test]
fn gl_binds_a_texture_from_its_first_layer_on() {
    // wgpu's GL backend drops the first layer of a view of several. `gpu::Tensor` slices no texture there.
    let found = written([5, 7, 4], 2);
    if driver() == Some(Driver::Gl) {
        assert_eq!(found, [1.0, 2.0, 0.0, 0.0]);
    } else {
        assert_eq!(found, [0.0, 0.0, 1.0, 2.0]);
    }
}

#[test]
fn swiftshader_makes_a_number_of_the_exponential_of_nan() {
    // WGSL leaves open what becomes of NaN. A mask of NaN is then `not_found` and not `invalid` there.
    let network = one_layer(Operation::Sigmoid, Shape::new(1, 1, 2), 1);
    let values = [f32::NAN, 0.0];
    assert!(on_reference(&network, &values)[0].is_nan());
    let found = on_gpu(&network, 1, &values);
    assert_eq!(
        found[0].is_nan(),
        driver() != Some(Driver::SwiftShader),
        "{found:?}"
    );
    assert_eq!(found[1], 0.5);
}
