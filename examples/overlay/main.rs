//! A window that shows a camera's pictures, the robot's mask over them and its joints as spheres: one
//! device, one submission a frame, and no picture that leaves the GPU.
//!
//! `cargo run --release --example overlay [-- FOLDER|VIDEO [WEIGHTS]]`

mod pictures;
mod scene;
mod video;

use std::error::Error;
use std::sync::Arc;
use std::time::Instant;

use pictures::Pictures;
use scene::Scene;
use whereabot::network::Model;
use winit::application::ApplicationHandler;
use winit::dpi::LogicalSize;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, EventLoop};
use winit::window::{Window, WindowId};

struct Application {
    model: Model,
    pictures: Pictures,
    running: Option<Running>,
    failure: Option<Box<dyn Error>>,
}

struct Running {
    window: Arc<Window>,
    scene: Scene,
    last_frame: Instant,
    /// A running mean, in milliseconds.
    frame_ms: f64,
}

impl Application {
    fn open(&self, event_loop: &ActiveEventLoop) -> Result<Running, Box<dyn Error>> {
        let [width, height] = self.pictures.size();
        let size = LogicalSize::new(width, height);
        let attributes = Window::default_attributes()
            .with_title("whereabot overlay")
            .with_inner_size(size);
        let window = Arc::new(event_loop.create_window(attributes)?);
        let scene = pollster::block_on(Scene::new(&window, &self.model))?;
        Ok(Running {
            window,
            scene,
            last_frame: Instant::now(),
            frame_ms: 0.0,
        })
    }

    fn draw(&mut self) -> Result<(), Box<dyn Error>> {
        let Some(running) = &mut self.running else {
            return Ok(());
        };
        if let Some((picture, camera)) = self.pictures.next()? {
            running.scene.show(&picture, &camera)?;
        }
        running.scene.draw(&running.window)?;
        let now = Instant::now();
        let ms = now.duration_since(running.last_frame).as_secs_f64() * 1e3;
        running.last_frame = now;
        running.frame_ms += 0.1 * (ms - running.frame_ms);
        let title = format!(
            "whereabot overlay: {}, {}, {:.1} ms a frame",
            self.pictures.name(),
            running.scene.status(),
            running.frame_ms
        );
        running.window.set_title(&title);
        running.window.request_redraw();
        Ok(())
    }

    /// The first failure ends the program.
    fn check(&mut self, event_loop: &ActiveEventLoop, result: Result<(), Box<dyn Error>>) {
        if let Err(error) = result {
            self.failure = Some(error);
            event_loop.exit();
        }
    }
}

impl ApplicationHandler for Application {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.running.is_none() {
            let opened = self.open(event_loop);
            let result = opened.map(|running| self.running = Some(running));
            self.check(event_loop, result);
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => event_loop.exit(),
            WindowEvent::Resized(size) => {
                if let Some(running) = &mut self.running {
                    running.scene.resize(size.width, size.height);
                }
            }
            WindowEvent::RedrawRequested => {
                let result = self.draw();
                self.check(event_loop, result);
            }
            _ => {}
        }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let pictures = arguments.next().unwrap_or("examples/images".to_owned());
    let weights = arguments
        .next()
        .unwrap_or("weights/ur5.safetensors".to_owned());
    let mut application = Application {
        model: Model::load(weights)?,
        pictures: Pictures::open(pictures.as_ref())?,
        running: None,
        failure: None,
    };
    EventLoop::new()?.run_app(&mut application)?;
    application.failure.map_or(Ok(()), Err)
}
