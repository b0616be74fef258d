use std::fmt::Write;

use super::Layout;

/// The whole WGSL of a kernel: the access to tensors in `layout`, if it uses that, then `sizes` as
/// constants, then its own `source`. Loops from zero to a sum of `sizes` are written out.
pub fn kernel_text(layout: Option<Layout>, sizes: &[(&str, usize)], source: &str) -> String {
    // Directives stand before all else.
    let (directives, source): (Vec<&str>, Vec<&str>) = source
        .split_inclusive('\n')
        .partition(|line| line.starts_with("enable "));
    let (mut text, source) = (directives.concat(), source.concat());
    if let Some(layout) = layout {
        text.push_str(include_str!("../../shaders/layout/geometry.wgsl"));
        text.push_str(match layout {
            Layout::Buffer => include_str!("../../shaders/layout/buffer.wgsl"),
            Layout::HalfBuffer => include_str!("../../shaders/layout/half_buffer.wgsl"),
            Layout::Texture => include_str!("../../shaders/layout/texture.wgsl"),
        });
    }
    for (name, value) in sizes {
        // Writing to a string does not fail.
        let _ = writeln!(text, "const {name} = {value}u;");
    }
    write_out_loops(&mut text, &source, sizes);
    text
}

/// Drivers do not unroll loops as long as a convolution's, and keep arrays in memory for them: three
/// times slower on lavapipe.
fn write_out_loops(text: &mut String, source: &str, sizes: &[(&str, usize)]) {
    let mut rest = source;
    while let Some((before, from)) = rest.split_once(FOR) {
        text.push_str(before);
        match counted(from, sizes) {
            Some((name, count, body, after)) => {
                for value in 0..count {
                    let _ = write!(text, "{{\nconst {name} = {value}u;");
                    write_out_loops(text, body, sizes);
                    text.push_str("}\n");
                }
                rest = after;
            }
            None => {
                text.push_str(FOR);
                rest = from;
            }
        }
    }
    text.push_str(rest);
}

const FOR: &str = "for (var ";

/// The variable, count and body of a loop to write out that begins with `from`, behind its [`FOR`],
/// and what comes after the loop.
fn counted<'a>(
    from: &'a str,
    sizes: &[(&str, usize)],
) -> Option<(&'a str, usize, &'a str, &'a str)> {
    let (head, rest) = from.split_once(") {")?;
    let (name, condition) = head.split_once(" = 0u; ")?;
    let (bound, _) = condition.split_once(" < ")?.1.split_once("; ")?;
    let count = sum(bound, sizes)?;
    let mut depth = 1_usize;
    let end = rest.find(|c| {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            _ => {}
        }
        depth == 0
    })?;
    let (body, after) = rest.split_at(end);
    Some((name, count, body, after.strip_prefix('}')?))
}

/// Of sizes and numbers; `None` where it has other terms.
fn sum(terms: &str, sizes: &[(&str, usize)]) -> Option<usize> {
    let mut total = 0_usize;
    let mut minus = false;
    for term in terms.split_whitespace() {
        match term {
            "+" => minus = false,
            "-" => minus = true,
            _ => {
                let named = sizes.iter().find(|(name, _)| *name == term);
                let value = match named {
                    Some((_, value)) => *value,
                    None => term.strip_suffix('u')?.parse().ok()?,
                };
                total = if minus {
                    total.checked_sub(value)?
                } else {
                    total + value
                };
            }
        }
    }
    Some(total)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loops_over_sizes_are_written_out_and_others_stay() {
        let source = "for (var block = 0u; block < blocks; block++) {\n\
            for (var i = 0u; i < N + 2u - 1u; i++) { for (var j = 0u; j < 1u; j++) { f(i, j); } }\n}";
        let text = kernel_text(None, &[("N", 1)], source);
        let flat = text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(
            flat,
            "const N = 1u; for (var block = 0u; block < blocks; block++) { \
             { const i = 0u; { const j = 0u; f(i, j); } } \
             { const i = 1u; { const j = 0u; f(i, j); } } }"
        );
        // Negative control: without the size, nothing is written out but what has none.
        assert!(kernel_text(None, &[], source).contains("i < N"));
    }
}
