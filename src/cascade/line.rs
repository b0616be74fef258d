use serde::Serialize;

use super::{Estimate, Joint, Status};

/// An estimate as JSON lines have it: metres in the camera optical frame, pixels of the image, no more digits than
/// it is worth.
#[derive(Debug, Serialize)]
pub(crate) struct EstimateLine<'a> {
    status: &'static str,
    coverage: f64,
    field: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    bbox_px: Option<[f64; 4]>,
    frame: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    joints: Option<Vec<JointLine<'a>>>,
}

#[derive(Debug, Serialize)]
struct JointLine<'a> {
    name: &'a str,
    xyz_m: [f64; 3],
    px: [f64; 2],
}

impl<'a> From<&'a Estimate> for EstimateLine<'a> {
    fn from(estimate: &'a Estimate) -> Self {
        Self {
            status: match estimate.status {
                Status::Found => "found",
                Status::NotFound => "not_found",
                Status::Invalid => "invalid",
            },
            coverage: rounded(estimate.coverage, 6),
            field: rounded(estimate.field, 4),
            bbox_px: estimate.bbox_px.map(|bbox| bbox.map(|v| rounded(v, 2))),
            frame: "camera_optical",
            joints: (!estimate.joints.is_empty())
                .then(|| estimate.joints.iter().map(JointLine::from).collect()),
        }
    }
}

impl<'a> From<&'a Joint> for JointLine<'a> {
    fn from(joint: &'a Joint) -> Self {
        Self {
            name: &joint.name,
            xyz_m: joint.xyz_m.map(|v| rounded(v, 5)),
            px: joint.px.map(|v| rounded(v, 2)),
        }
    }
}

/// To `digits` behind the point.
pub(crate) fn rounded(value: f64, digits: i32) -> f64 {
    let scale = 10_f64.powi(digits);
    (value * scale).round() / scale
}
