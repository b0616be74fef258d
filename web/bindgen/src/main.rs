//! `whereabot-bindgen FILE.wasm DIR` writes the JavaScript module that a page loads, and its wasm.

use std::env::args;

use anyhow::Context;
use wasm_bindgen_cli_support::Bindgen;

fn main() -> anyhow::Result<()> {
    let mut args = args().skip(1);
    let (Some(input), Some(output), None) = (args.next(), args.next(), args.next()) else {
        anyhow::bail!("usage: whereabot-bindgen FILE.wasm DIR");
    };
    Bindgen::new()
        .input_path(&input)
        .web(true)?
        .typescript(false)
        .omit_default_module_path(false)
        .generate(&output)
        .with_context(|| format!("{input}: no bindings"))
}
