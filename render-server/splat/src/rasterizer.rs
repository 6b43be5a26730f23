//! Interface of all renderers: (scene, placements of its objects, cameras) -> images.

use std::borrow::Cow;

use crate::{Camera, InvalidCamera, Placement, RgbdImage};

/// Renderer with its own packed copy of a scene.
pub trait Rasterizer: Send {
    /// Returns the device's name for reports: `cpu avx2`, `gpu NVIDIA GeForce RTX 3080 (Vulkan)`.
    fn name(&self) -> Cow<'_, str>;

    /// Renders one image per camera, resizes each image, and returns the time of each pass. `placements` has one
    /// entry per object of the scene.
    ///
    /// # Errors
    /// [`RenderError`]; images are then unspecified, and the next call may succeed.
    ///
    /// # Panics
    /// If the number of images differs from that of the cameras, or the number of placements from that of the
    /// objects.
    fn render(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
        images: &mut [RgbdImage],
    ) -> Result<PassTimes, RenderError>;

    /// Returns the amount of work for the last camera.
    fn workload(&self) -> Workload;
}

/// Duration of each pass, summed over the cameras of a call; 0 if the renderer does not have the pass or cannot time
/// it. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PassTimes {
    /// Test of the blocks of splats against the view. [ms]
    pub cull_ms: f32,
    /// Projection of splats onto the image plane. [ms]
    pub project_ms: f32,
    /// Sorting by depth. [ms]
    pub sort_ms: f32,
    /// Assignment of splats to tiles. [ms]
    pub bin_ms: f32,
    /// Blending of tiles to pixels. [ms]
    pub blend_ms: f32,
    /// Copy from the device's memory to the images. [ms]
    pub read_ms: f32,
    /// Complete call. [ms]
    pub total_ms: f32,
}

/// Amount of work for an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Workload {
    /// Splats in the renderer's packed scene.
    pub splats: usize,
    /// Splats that touch the image.
    pub visible: usize,
    /// (Tile, splat) pairs.
    pub pairs: usize,
}

/// Why rendering failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// First invalid camera; no image is changed.
    #[error(transparent)]
    Camera(#[from] InvalidCamera),
    /// Placement of an object is not a rotation and a finite position; no image is changed.
    #[error(
        "object {0} is placed at {1}, which is not a rotation and a finite position within 1e7 m"
    )]
    Placement(usize, String),
    /// Graphics device is lost or out of memory; with the reason.
    #[error("the graphics device cannot render this: {0}; use the processor")]
    Device(String),
    /// Packed scene cannot be read, or a complete image needs more memory than is available; with the reason.
    #[error("{0}")]
    Scene(String),
}

/// Checks the arguments of a call to any renderer.
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
