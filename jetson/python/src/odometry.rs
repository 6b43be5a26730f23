//! A plugin's own estimate of where it is.

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use vizflyt_sdk::{HostTime, Pose};

use crate::arguments::{quaternion, vector};

/// Publishes where the plugin thinks the vehicle was at `stamp_ns`; of an estimate from an image that is
/// `image.shown_ns`. It leaves with the answer to the image, is logged on `/odometry`, and `vizflyt grade` reports how
/// far off it was. Nothing is flown by it.
///
/// `p_odom_m` is the body's position, shape (3,) [m]; `rotation_xyzw` the unit quaternion that rotates from body to
/// odom axes, shape (4,). z of the frame `odom` is up; its origin and heading are the plugin's choice.
///
/// Raises NotFiniteError or ValueError for what is no pose, ValueError for more than four in one `on_image`.
#[pyfunction]
pub(crate) fn publish_odometry(
    stamp_ns: u64,
    p_odom_m: &Bound<'_, PyAny>,
    rotation_xyzw: &Bound<'_, PyAny>,
) -> PyResult<()> {
    let p_odom_m = vector(p_odom_m, "p_odom_m")?;
    let rotation = quaternion(rotation_xyzw, "rotation_xyzw")?;
    let pose = Pose::new(p_odom_m, rotation);
    vizflyt_sdk::publish_odometry(HostTime::from_ns(stamp_ns), pose)
        .map_err(|error| PyValueError::new_err(error.to_string()))
}
