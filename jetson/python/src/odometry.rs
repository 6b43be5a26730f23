//! Odometry that a plugin publishes.

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use vizflyt_sdk::{HostTime, Pose};

use crate::arguments::{quaternion, vector};

/// Publishes the plugin's estimate of the vehicle's pose at `stamp_ns`. For an estimate from an image, pass
/// `image.shown_ns`. The estimate is sent with the reply to the image and logged on `/odometry`, and `vizflyt
/// grade` reports its error. It does not control the flight.
///
/// `p_odom_m` is the body's position, shape (3,) [m]; `rotation_xyzw` is the unit quaternion that rotates from
/// body to odom axes, shape (4,). z of the frame `odom` is up; the plugin chooses its origin and heading.
///
/// Raises NotFiniteError or ValueError for an invalid pose, ValueError for more than four in one `on_image`.
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
