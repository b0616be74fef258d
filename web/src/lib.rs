//! What the page's scripts call: a robot's model on the browser's GPU ([`Gpu`]) or in plain Rust
//! ([`Cpu`]). Answers are JSON; see `answer.rs`.
#![cfg(target_arch = "wasm32")]
// The library shares devices by `Arc`; here there is one thread.
#![allow(clippy::arc_with_non_send_sync)]

mod answer;
mod cpu;
mod gpu;
mod screen;

pub use cpu::Cpu;
pub use gpu::Gpu;
use wasm_bindgen::prelude::*;

/// Panics are defects; their message is for who reports one.
#[wasm_bindgen(start)]
fn start() {
    std::panic::set_hook(Box::new(|info| {
        web_sys::console::error_1(&info.to_string().into());
    }));
}

/// The horizontal field of view that is assumed for a picture of which nothing is known, in degrees.
#[wasm_bindgen]
pub fn assumed_hfov(width: u32, height: u32) -> f64 {
    let camera = whereabot::camera::Camera::assumed(width, height);
    2.0 * (0.5 * f64::from(width) / camera.intrinsics.fx)
        .atan()
        .to_degrees()
}

/// Tells `script` what is being done.
fn progress(script: &js_sys::Function) -> impl FnMut(&str) {
    move |what| {
        // Whether a page shows it is the page's own affair.
        let _ = script.call1(&JsValue::NULL, &what.into());
    }
}
