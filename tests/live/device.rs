//! The GPU as engine: answers as of single images, batches, and a device that is lost in mid-stream.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use image::RgbaImage;
use serde_json::json;
use whereabot::camera::Camera;
use whereabot::cascade::{
    BatchImage, BatchLocator, BatchOptions, Estimate, LocateError, Locator, Output, Status,
};
use whereabot::gpu::{AdapterRequest, Device, GpuError, Precision};
use whereabot::live::{Engine, EventKind, Frame, GpuEngine, GpuOptions, Observation, Stop};
use whereabot::network::Model;

use super::known::{XYZ, model};
use super::simulated::{Collector, Simulated, Told, watch};

/// The tiny model, whose joints depend on the image.
pub fn tiny() -> Model {
    Model::from_bytes(&model("cube", XYZ, 0.002, &json!({})), "tiny").unwrap()
}

fn open() -> Arc<Device> {
    Arc::new(Device::open(&AdapterRequest::new(None, None)).unwrap())
}

/// An engine for `cameras` cameras, and the devices that it opens.
pub fn engine(cameras: usize, mask: bool) -> (GpuEngine, Arc<Mutex<Vec<Arc<Device>>>>) {
    let devices = Arc::new(Mutex::new(Vec::new()));
    let opened = Arc::clone(&devices);
    let open = move || -> Result<Arc<Device>, GpuError> {
        let device = open();
        opened.lock().unwrap().push(Arc::clone(&device));
        Ok(device)
    };
    let options = GpuOptions {
        precision: Precision::F32,
        cameras,
        mask,
    };
    let engine = GpuEngine::new(Box::new(open), vec![tiny()], options).unwrap();
    (engine, devices)
}

/// What a single-image run says of an observation's image, bit by bit.
pub struct Judge(Locator);

impl Judge {
    pub fn new() -> Self {
        Self(Locator::on_gpu(super::common::device(), &tiny(), Precision::F32).unwrap())
    }

    pub fn agrees(&mut self, observation: &Observation) -> bool {
        self.agrees_with(&observation.estimate, &observation.image, &observation.view)
    }

    pub fn agrees_with(&mut self, found: &Estimate, image: &RgbaImage, camera: &Camera) -> bool {
        let output = Output {
            mask: found.mask.is_some(),
            mask_only: false,
        };
        self.0.locate(image, camera, output).unwrap() == *found
    }
}

fn picture(red: u8, width: u32) -> RgbaImage {
    RgbaImage::from_fn(width, 48, |x, y| {
        image::Rgba([128 + red / 4 + ((x + 2 * y) / 4) as u8, 3 * y as u8, 9, 255])
    })
}

#[test]
fn batches_answer_as_single_images_do_and_several_are_under_way() {
    let (mut judge, device, model) = (Judge::new(), open(), tiny());
    let cameras = 5;
    let options = |batch| BatchOptions {
        precision: Precision::F32,
        cameras,
        batch,
        in_flight: 2,
        mask: true,
    };
    let images: Vec<RgbaImage> = (0..cameras)
        .map(|c| picture(50 * c as u8, 40 + 8 * c as u32))
        .collect();
    let views: Vec<Camera> = images
        .iter()
        .map(|i| Camera::from_hfov(i.width(), i.height(), 1.2))
        .collect();
    let image = |place: usize| BatchImage {
        place,
        image: &images[place],
        camera: &views[place],
    };
    for batch in [1, 2, 4] {
        let mut locator = BatchLocator::new(Arc::clone(&device), &model, options(batch)).unwrap();
        // The cameras take turns in places of the batch.
        let rounds = [0, 3, 1].map(|first| {
            (0..batch)
                .map(|i| image((first + i) % cameras))
                .collect::<Vec<_>>()
        });
        assert!(locator.finished().unwrap().is_none());
        assert!(locator.submit(&rounds[0]).unwrap());
        assert!(locator.submit(&rounds[1]).unwrap());
        assert!(!locator.submit(&rounds[2]).unwrap());
        assert_eq!(locator.in_flight(), 2);
        for round in &rounds[..2] {
            let found = wait(&mut locator);
            assert_eq!(found.len(), batch);
            for (found, image) in found.iter().zip(round) {
                assert!(judge.agrees_with(found, image.image, image.camera));
                assert_eq!(found.status, Status::Found);
            }
            // Negative control: it is not any picture's.
            let other = (round[0].place + 1) % cameras;
            assert!(!judge.agrees_with(&found[0], &images[other], &views[other]));
        }
        let wrong = locator.submit(&[]).unwrap_err();
        assert!(matches!(wrong, LocateError::Gpu(GpuError::Size { .. })));
    }
}

fn wait(locator: &mut BatchLocator) -> Vec<Estimate> {
    let start = Instant::now();
    loop {
        if let Some(found) = locator.finished().unwrap() {
            return found;
        }
        assert!(start.elapsed() < Duration::from_secs(30));
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_lost_device_is_opened_again_and_nothing_is_invented_meanwhile() {
    let (engine, devices) = engine(2, false);
    let collector = Collector::default();
    let stop = Arc::new(Stop::default());
    let cameras = (0..2).map(|_| Simulated::new(Duration::from_millis(20), 150).input());
    let breaker = {
        let (devices, collector) = (Arc::clone(&devices), collector.clone());
        std::thread::spawn(move || {
            while collector.observations().len() < 20 {
                std::thread::sleep(Duration::from_millis(5));
            }
            devices.lock().unwrap().last().unwrap().wgpu().destroy();
        })
    };
    let sinks = vec![Box::new(collector.clone()) as _];
    watch(cameras.collect(), Box::new(engine), sinks, &stop);
    breaker.join().unwrap();
    assert_eq!(devices.lock().unwrap().len(), 2);
    let told = collector.told.lock().unwrap().clone();
    let place = |wanted: fn(&EventKind) -> bool| {
        let mut told = told.iter();
        told.position(|told| matches!(told, Told::Event(event) if wanted(&event.kind)))
    };
    let lost = place(|kind| matches!(kind, EventKind::DeviceLost { .. })).unwrap();
    let back = place(|kind| *kind == EventKind::DeviceBack).unwrap();
    let answers = |told: &[Told]| {
        let answers = told.iter().filter(|t| matches!(t, Told::Observation(_)));
        answers.count()
    };
    assert_eq!(answers(&told[lost..back]), 0);
    assert!(answers(&told[..lost]) >= 20 && answers(&told[back..]) > 0);
    let mut judge = Judge::new();
    assert!(collector.observations().iter().all(|o| judge.agrees(o)));
}

#[test]
fn an_engine_says_what_is_lost_with_its_device() {
    let (mut engine, devices) = engine(1, false);
    let image = picture(200, 64);
    let frame = Frame {
        camera: 0,
        number: 0,
        file: None,
        acquired: SystemTime::now(),
        acquired_at: Instant::now(),
        view: Camera::from_hfov(64, 48, 1.2),
        image: Arc::new(image),
    };
    engine.submit(0, std::slice::from_ref(&frame)).unwrap();
    devices.lock().unwrap()[0].wgpu().destroy();
    let lost = |error: LocateError| matches!(error, LocateError::Gpu(GpuError::Lost(_)));
    let start = Instant::now();
    loop {
        match engine.finished() {
            // wgpu tells late, but it does.
            Ok(None) => assert!(start.elapsed() < Duration::from_secs(10)),
            // It was done before.
            Ok(Some(found)) => {
                assert!(Judge::new().agrees_with(&found[0], &frame.image, &frame.view));
                break;
            }
            Err(error) => {
                assert!(lost(error));
                break;
            }
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let frames = std::slice::from_ref(&frame);
    assert!(lost(engine.submit(0, frames).unwrap_err()));
    engine.reopen().unwrap();
    // What was under way is forgotten.
    assert!(engine.finished().unwrap().is_none());
    engine.submit(0, &[frame]).unwrap();
}
