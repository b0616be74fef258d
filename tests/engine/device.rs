//! A device's faults come back as values, and nothing computed by a lost device is a result.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::common::{description, model_file, noise, one_layer};
use image::RgbaImage;
use whereabot::camera::Camera;
use whereabot::cascade::{LocateError, Locator, Output};
use whereabot::gpu::{
    AdapterRequest, Device, GpuError, Layout, NetworkPlan, Precision, Tensor, list_adapters,
};
use whereabot::network::{Activation, Model, Operation, Shape};

/// A device of its own, to be broken.
fn open() -> Device {
    Device::open(&AdapterRequest::new(None, None)).unwrap()
}

#[test]
fn the_adapter_in_use_is_listed() {
    let request = AdapterRequest::new(None, None);
    let (adapters, choice) = list_adapters(&request).unwrap();
    let choice = choice.unwrap();
    let chosen = &adapters[choice.index];
    let opened = open();
    assert_eq!(chosen.info.name, opened.info().name);
    assert_eq!(chosen.info.backend, opened.info().backend);
    assert_eq!(choice.index, opened.choice().unwrap().index);
    assert!(chosen.unusable.is_none());
}

#[test]
fn an_unknown_adapter_lists_what_there_is() {
    let error = Device::open(&AdapterRequest::new(Some("no such card"), None)).unwrap_err();
    let name = open().info().name.clone();
    assert!(
        matches!(&error, GpuError::UnknownAdapter { available, .. } if available.iter().any(|a| a.contains(&name)))
    );
}

#[test]
fn a_destroyed_device_is_an_error_and_not_a_result() {
    let device = Arc::new(open());
    let model = Model::from_bytes(&model_file(&description(32, 24, 4), 1), "random").unwrap();
    let mut locator = Locator::on_gpu(Arc::clone(&device), &model, Precision::F32).unwrap();
    let image = RgbaImage::new(40, 30);
    let camera = Camera::from_hfov(40, 30, 1.0);
    // Negative control: before, there is a result.
    locator.locate(&image, &camera, Output::default()).unwrap();
    device.wgpu().destroy();
    let start = Instant::now();
    let error = locator
        .locate(&image, &camera, Output::default())
        .unwrap_err();
    assert!(
        matches!(error, LocateError::Gpu(GpuError::Lost(_))),
        "{error}"
    );
    assert!(start.elapsed() < Duration::from_secs(1));
    // It stays lost, and another one is fine.
    locator
        .locate(&image, &camera, Output::default())
        .unwrap_err();
    Locator::on_gpu(Arc::new(open()), &model, Precision::F32)
        .unwrap()
        .locate(&image, &camera, Output::default())
        .unwrap();
}

#[test]
fn a_driver_s_refusal_is_an_error() {
    let device = open();
    let refused = device.scoped(|| {
        Ok(device.wgpu().create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: 4,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::STORAGE,
            mapped_at_creation: false,
        }))
    });
    assert!(matches!(refused, Err(GpuError::Validation(_))));
    // One refusal within a scope does not condemn the device.
    device.check().unwrap();
}

#[test]
fn a_network_beyond_the_adapter_s_limits_names_the_layer() {
    let device = crate::common::device();
    let operation = Operation::Conv2d {
        out_channels: 4096,
        kernel: 1,
        dilation: 1,
        activation: Activation::None,
    };
    let limits = device.wgpu().limits();
    let side = 4 * (limits.max_storage_buffer_binding_size as f64 / (4096.0 * 4.0)).sqrt() as usize;
    for (layout, batch, [rows, columns]) in [
        (Layout::Buffer, 32, [side, side / 256]),
        (
            Layout::Texture,
            limits.max_texture_array_layers as usize,
            [8, 1],
        ),
    ] {
        let network = one_layer(operation, Shape::new(1, rows, columns), 1);
        let input = NetworkPlan::input(&device, layout, "input", &network, batch).unwrap();
        let error = NetworkPlan::new(&device, "mask", &network, &input).unwrap_err();
        let text = error.to_string();
        assert!(
            text.contains("mask.layer") && text.contains("allows"),
            "{text}"
        );
    }
}

#[test]
fn an_image_beyond_the_adapter_s_limits_is_refused() {
    let device = crate::common::device();
    let side = device.wgpu().limits().max_texture_dimension_2d + 1;
    let model = Model::from_bytes(&model_file(&description(32, 24, 4), 1), "random").unwrap();
    let mut locator = Locator::on_gpu(Arc::clone(&device), &model, Precision::F32).unwrap();
    let camera = Camera::from_hfov(side, 2, 1.0);
    let error = locator.locate(&RgbaImage::new(side, 2), &camera, Output::default());
    assert!(matches!(
        error,
        Err(LocateError::Gpu(GpuError::Limit { .. }))
    ));
    // The locator goes on with the next image.
    let camera = Camera::from_hfov(40, 30, 1.0);
    locator
        .locate(&RgbaImage::new(40, 30), &camera, Output::default())
        .unwrap();
}

#[test]
fn an_image_of_another_size_than_the_camera_s_is_refused() {
    let model = Model::from_bytes(&model_file(&description(32, 24, 4), 1), "random").unwrap();
    let camera = Camera::from_hfov(41, 30, 1.0);
    let error = Locator::on_cpu(&model).locate(&RgbaImage::new(40, 30), &camera, Output::default());
    let text = error.unwrap_err().to_string();
    assert!(
        text.contains("41 x 30") && text.contains("40 x 30"),
        "{text}"
    );
}

#[test]
fn a_wrong_number_of_values_is_refused() {
    let device = crate::common::device();
    let tensor = Tensor::new(&device, "input", Shape::new(2, 3, 4), 2).unwrap();
    tensor.write(&device, &noise(48, 1)).unwrap();
    let error = tensor.write(&device, &noise(47, 1)).unwrap_err();
    assert!(matches!(
        error,
        GpuError::Size {
            expected: 48,
            found: 47,
            ..
        }
    ));
}
