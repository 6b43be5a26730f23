//! The one contract of all renderers: (scene, placements of its objects, cameras) -> images.

use std::borrow::Cow;

use crate::{Camera, InvalidCamera, Placement, RgbdImage};

/// Renders a scene that it holds a packed copy of.
pub trait Rasterizer: Send {
    /// Returns what it runs on, for reports: `cpu avx2`, `gpu NVIDIA GeForce RTX 3080 (Vulkan)`.
    fn name(&self) -> Cow<'_, str>;

    /// Renders one image per camera, resizing each, and returns how long the passes took.
    /// `placements` has one entry per object of the scene.
    ///
    /// # Errors
    /// [`RenderError`]; images are unspecified then, and the next call may succeed.
    ///
    /// # Panics
    /// If there are not as many images as cameras, or placements as objects.
    fn render(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
        images: &mut [RgbdImage],
    ) -> Result<PassTimes, RenderError>;

    /// Returns how much work the last camera was.
    fn workload(&self) -> Workload;
}

/// How long each pass took, summed over the cameras of a call; 0 where a renderer has no such pass
/// or cannot time it. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PassTimes {
    /// Blocks of splats against the view. [ms]
    pub cull_ms: f32,
    /// Splats onto the image plane. [ms]
    pub project_ms: f32,
    /// By depth. [ms]
    pub sort_ms: f32,
    /// Into tiles. [ms]
    pub bin_ms: f32,
    /// Tiles to pixels. [ms]
    pub blend_ms: f32,
    /// From the device's memory to the images. [ms]
    pub read_ms: f32,
    /// The whole call. [ms]
    pub total_ms: f32,
}

/// How much work an image was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Workload {
    /// Splats the renderer keeps.
    pub splats: usize,
    /// Splats that touch the image.
    pub visible: usize,
    /// (Tile, splat) pairs.
    pub pairs: usize,
}

/// Why nothing was rendered.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// The first camera that is not valid; no image is changed.
    #[error(transparent)]
    Camera(#[from] InvalidCamera),
    /// The placement of an object is no rotation and finite position; no image is changed.
    #[error("object {0} is placed at {1}, which is no rotation and finite position within 1e7 m")]
    Placement(usize, String),
    /// The graphics device is gone, or cannot hold what was asked of it, and why.
    #[error("the graphics device cannot render this: {0}; use the processor")]
    Device(String),
    /// A packed scene cannot be read, or an image that is to be whole needs more memory than it has; and why.
    #[error("{0}")]
    Scene(String),
}

/// Checks what every renderer asks of a call.
pub(crate) fn validate(
    objects: usize,
    placements: &[Placement],
    cameras: &[Camera],
    images: &[RgbdImage],
) -> Result<(), RenderError> {
    assert_eq!(cameras.len(), images.len(), "one image per camera");
    assert_eq!(objects, placements.len(), "one placement per object");
    cameras.iter().try_for_each(Camera::validate)?;
    for (i, pose) in placements.iter().enumerate() {
        if let Some(pose) = pose
            && !(pose.is_valid() && pose.translation_m.abs().max_element() <= 1e7)
        {
            return Err(RenderError::Placement(i, format!("{pose:?}")));
        }
    }
    Ok(())
}
