//! The cascade on tract: `whereabot-peer-tract PICTURES ANSWERS HEIGHT WIDTH THREADS ONNX`. See `../README.md`.

#[path = "../../serve.rs"]
mod serve;

use std::error::Error;

use serve::{argument, serve};
use tract_linalg::multithread::{Executor, set_default_executor};
use tract_onnx::prelude::*;

fn main() -> Result<(), Box<dyn Error>> {
    let [height, width] = [
        argument(3, "HEIGHT")?.parse()?,
        argument(4, "WIDTH")?.parse()?,
    ];
    let threads: usize = argument(5, "THREADS")?.parse()?;
    if threads > 1 {
        set_default_executor(Executor::multithread(threads));
    }
    let model = tract_onnx::onnx()
        .model_for_path(argument(6, "ONNX")?)?
        .into_optimized()?
        .into_runnable()?;
    serve(
        &argument(1, "PICTURES")?,
        &argument(2, "ANSWERS")?,
        [height, width],
        "CPU",
        |picture| {
            let picture = Tensor::from_shape(&[1, 3, height, width], picture)?;
            let found = model.run(tvec!(picture.into()))?;
            let values = |index: usize| -> TractResult<Vec<f32>> {
                Ok(found[index]
                    .to_plain_array_view::<f32>()?
                    .iter()
                    .copied()
                    .collect())
            };
            Ok((values(0)?, values(1)?))
        },
    )
}
