//! The renderer behind one small trait, so that GPU and CPU are exchangeable.

use vizflyt_splat::{Camera, CpuRenderer, InvalidCamera, RgbdImage, Splats};

/// Draws a scene it holds.
pub trait Renderer: Send {
    /// Draws each camera into the image of the same index.
    ///
    /// # Errors
    /// The first camera that cannot be drawn; images are then unspecified.
    fn draw(&mut self, cameras: &[Camera], images: &mut [RgbdImage]) -> Result<(), InvalidCamera>;

    /// Returns its name for reports: `cpu avx2`.
    fn name(&self) -> String;
}

impl Renderer for CpuRenderer {
    fn draw(&mut self, cameras: &[Camera], images: &mut [RgbdImage]) -> Result<(), InvalidCamera> {
        self.render(cameras, images).map(|_| ())
    }

    fn name(&self) -> String {
        CpuRenderer::name(self).to_owned()
    }
}

/// Returns the fastest renderer this machine has for a scene, which it copies.
pub fn best(splats: &Splats) -> Box<dyn Renderer> {
    Box::new(CpuRenderer::new(splats))
}
