//! The autopilot's parameters for this airframe: the files in `hardware/airframe`, the parameter names of three
//! ArduCopter versions, and values that are dangerous in a room.
//!
//! ```text
//! hardware/airframe/*.param ── file ──▶ wanted ────┐
//! autopilot ── param_session ──▶ firmware, values ─┴─ compare ──▶ differences ──▶ report; --apply
//! arena ── autopilot_fence ──▶ heights and circle into `wanted`; polygons of the fence, uploaded
//! ```

mod autopilot_fence;
mod compare;
mod file;
mod names;
#[cfg(test)]
mod pages;
mod param_session;
mod rules;
mod tuning;

pub use autopilot_fence::{AutopilotFence, FenceCylinder};
pub use compare::{Difference, compare};
pub use file::{ParamFileError, parse_params};
pub use names::{ParamSpec, Version, param_spec};
pub use param_session::{ParamSession, ParamSessionError};
pub use rules::{RULES, Rule, contradictions};

/// Returns the parameter file of this airframe for a version.
pub fn shipped(version: Version) -> &'static str {
    match version {
        Version::V45 => include_str!("../../../../hardware/airframe/whippet-copter-4.5.param"),
        Version::V46 => include_str!("../../../../hardware/airframe/whippet-copter-4.6.param"),
        Version::V48 => include_str!("../../../../hardware/airframe/whippet-copter-4.8.param"),
    }
}
