/// The longest side of a frame.
pub(super) const MAX_SIDE: u32 = 8192;

/// What a line of ffmpeg's log says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Line<'a> {
    /// A frame comes.
    Frame {
        /// Columns and rows.
        size: [u32; 2],
        /// When it was taken, seconds by the stream's own clock.
        time_s: Option<f64>,
    },
    /// Something went wrong.
    Error(&'a str),
    Other,
}

impl<'a> Line<'a> {
    /// Of `[Parsed_showinfo_1 @ 0x1] [info] n:   0 pts:      0 ... s:320x240 i:P ...`, of
    /// `[in#0 @ 0x1] [error] Connection refused`, and of others.
    pub fn new(text: &'a str) -> Self {
        if text.contains("Parsed_showinfo") {
            return frame(text).unwrap_or(Self::Other);
        }
        let error = ["[error] ", "[fatal] "].into_iter().find_map(|level| {
            let at = text.find(level)?;
            text.get(at + level.len()..)
        });
        error.map_or(Self::Other, |what| Self::Error(what.trim_end()))
    }
}

fn frame<'a>(text: &str) -> Option<Line<'a>> {
    let mut fields = text.split_ascii_whitespace();
    fields.by_ref().find(|field| field.starts_with("n:"))?;
    let value = |key| fields.clone().find_map(|field| field.strip_prefix(key));
    let (width, height) = value("s:")?.split_once('x')?;
    Some(Line::Frame {
        size: [width.parse().ok()?, height.parse().ok()?],
        // `NOPTS` where there is none.
        time_s: value("pts_time:").and_then(|time| time.parse().ok()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_and_errors_are_told_from_the_rest() {
        let of_5 = "[Parsed_showinfo_1 @ 0x55] [info] n:   5 pts:  45000 pts_time:0.5     pos:    20116 \
                    fmt:rgba sar:1/1 s:320x240 i:P iskey:0 type:P \n";
        let of_7 = "[Parsed_showinfo_1 @ 0x55] [info] n:1234 pts: 1 pts_time:0.1 duration:1 \
                    duration_time:0.1 fmt:rgba cl:unspecified sar:1/1 s:64x48 i:P iskey:1 type:I";
        let without = of_5.replace("pts_time:0.5", "pts_time:NOPTS");
        let frame = |size, time_s| Line::Frame { size, time_s };
        assert_eq!(Line::new(of_5), frame([320, 240], Some(0.5)));
        assert_eq!(Line::new(of_7), frame([64, 48], Some(0.1)));
        assert_eq!(Line::new(&without), frame([320, 240], None));
        let refused = "[tcp @ 0x1] [error] Connection to tcp://127.0.0.1:1 failed\n";
        let text = "Connection to tcp://127.0.0.1:1 failed";
        assert_eq!(Line::new(refused), Line::Error(text));
        for other in [
            "[Parsed_showinfo_1 @ 0x55] [info] config in time_base: 1/90000, frame_rate: 10/1",
            "[Parsed_showinfo_1 @ 0x55] [info]   side data - s:320x240",
            "[Parsed_showinfo_1 @ 0x55] [info] n: 1 s:-1x240",
            "[info] Stream #0:0: Video: rawvideo, rgba, n: 1 s:320x240",
            "",
        ] {
            assert_eq!(Line::new(other), Line::Other, "{other}");
        }
    }
}
