//! A pinhole camera placed in the world.

use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

/// What is drawn, from where.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Size, focal lengths, principal point.
    pub intrinsics: Intrinsics,
    /// Where the camera is.
    pub world_from_cam: Pose<World, Cam>,
    /// Splats nearer than this are not drawn. [m]
    pub near_m: f32,
    /// Linear RGB shown where nothing covers the pixel.
    pub background: [f32; 3],
}
