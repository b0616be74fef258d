use serde_json::json;
use whereabot::cascade::{Estimate, Status};

/// An estimate for the page: `{"status", "coverage", "joints": [{"name", "xyz_m", "px"}]}`, as
/// `whereabot locate --json` names and means them.
pub fn to_json(estimate: &Estimate) -> String {
    let joints = estimate
        .joints
        .iter()
        .map(|joint| json!({ "name": joint.name, "xyz_m": joint.xyz_m, "px": joint.px }));
    let status = match estimate.status {
        Status::Found => "found",
        Status::NotFound => "not_found",
        Status::Invalid => "invalid",
    };
    json!({
        "status": status,
        "coverage": estimate.coverage,
        "joints": joints.collect::<Vec<_>>(),
    })
    .to_string()
}
