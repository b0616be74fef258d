//! Cameras' names in ROS.

use std::collections::BTreeMap;

/// A camera's name as a part of a topic and as a frame: letters, digits and `_`, and no digit first.
pub fn name(camera: &str) -> String {
    let begins_with_digit = camera.starts_with(|c: char| c.is_ascii_digit());
    let first = (begins_with_digit || camera.is_empty()).then_some('_');
    let rest = camera
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' });
    first.into_iter().chain(rest).collect()
}

/// The frame of what a camera of this name sees: optical, as REP 103 has it.
pub fn optical_frame(camera: &str) -> String {
    format!("{}_optical", name(camera))
}

/// Two of `cameras` that have the same [`name`].
pub fn alike<'a>(cameras: impl IntoIterator<Item = &'a str>) -> Option<[&'a str; 2]> {
    let mut seen = BTreeMap::new();
    cameras
        .into_iter()
        .find_map(|camera| Some([seen.insert(name(camera), camera)?, camera]))
}
