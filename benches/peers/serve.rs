// What the programs share: pictures in, answers and times out. `worker.py` speaks the same way.

use std::error::Error;
use std::io::{BufRead, Write};
use std::time::Instant;

/// A mask, row by row, and the joints' x, y, z in metres.
pub type Answer = (Vec<f32>, Vec<f32>);

/// The argument at `index`, or an error that names it.
pub fn argument(index: usize, name: &str) -> Result<String, Box<dyn Error>> {
    std::env::args()
        .nth(index)
        .ok_or_else(|| format!("expected {name} as argument {index}, found none").into())
}

/// Reads f32 pictures of `[3, height, width]`, side by side in the file `pictures`; prints a line after the first
/// answer and, with all answers written to the file `answers`, another. Then each line from stdin, a number, is answered
/// by as many times in ms, after one frame that is not timed.
pub fn serve(
    pictures: &str,
    answers: &str,
    [height, width]: [usize; 2],
    device: &str,
    mut infer: impl FnMut(&[f32]) -> Result<Answer, Box<dyn Error>>,
) -> Result<(), Box<dyn Error>> {
    let values: Vec<f32> = std::fs::read(pictures)?
        .chunks_exact(4)
        .map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
        .collect();
    let pictures: Vec<&[f32]> = values.chunks_exact(3 * height * width).collect();
    let mut stdout = std::io::stdout();

    let mut written = Vec::new();
    for (number, picture) in pictures.iter().enumerate() {
        let (mask, joints) = infer(picture)?;
        if number == 0 {
            writeln!(stdout, "> {{\"device\": \"{device}\"}}")?;
            stdout.flush()?;
        }
        written.extend(
            mask.iter()
                .chain(&joints)
                .flat_map(|value| value.to_le_bytes()),
        );
    }
    std::fs::write(answers, written)?;
    let mut next = pictures.iter().cycle();
    let mut time = || -> Result<f64, Box<dyn Error>> {
        let picture = next.next().ok_or("no picture")?;
        let clock = Instant::now();
        infer(picture)?;
        Ok(clock.elapsed().as_secs_f64() * 1e3)
    };
    writeln!(stdout, "> {{\"ms\": {}}}", time()?)?;
    stdout.flush()?;
    for line in std::io::stdin().lock().lines() {
        let frames: usize = line?.trim().parse()?;
        time()?;
        let times = (0..frames).map(|_| time()).collect::<Result<Vec<_>, _>>()?;
        writeln!(stdout, "> {times:?}")?;
        stdout.flush()?;
    }
    Ok(())
}
