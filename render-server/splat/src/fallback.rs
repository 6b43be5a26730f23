//! Renderer that continues on the processor if its device is lost, for example by a driver reset. The current image
//! and all later images are then rendered by the processor.
//!
//! Cost: a second packed copy of the scene from the start, 52 bytes per splat and 6 to 96 for its harmonics (0.74 GB
//! for 5 M splats of degree 3). Packing takes seconds, too long during a flight.

use std::borrow::Cow;

use crate::{
    Camera, CpuRenderer, PassTimes, Placement, Rasterizer, RenderError, RgbdImage, Workload,
};

/// Renderer on a device, with the processor as fallback.
pub struct FallbackRenderer {
    active: Box<dyn Rasterizer>,
    /// Fallback until it is needed.
    spare: Option<CpuRenderer>,
    /// Name after the fallback: active renderer, lost renderer and reason.
    renamed: Option<String>,
}

impl FallbackRenderer {
    /// Adds the fallback `spare`, a CPU renderer of the same scene, to `first`.
    pub fn new(first: Box<dyn Rasterizer>, spare: CpuRenderer) -> Self {
        Self { active: first, spare: Some(spare), renamed: None }
    }
}

impl Rasterizer for FallbackRenderer {
    /// Returns the active renderer, and after a fallback also the lost one: `cpu avx2, for gpu X is lost: ...`.
    fn name(&self) -> Cow<'_, str> {
        self.renamed.as_deref().map_or_else(|| self.active.name(), Cow::Borrowed)
    }

    fn render(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
        images: &mut [RgbdImage],
    ) -> Result<PassTimes, RenderError> {
        match self.active.render(placements, cameras, images) {
            Err(RenderError::Device(why)) if self.spare.is_some() => {
                if let Some(spare) = self.spare.take() {
                    let (now, lost) = (spare.name(), self.active.name());
                    self.renamed = Some(format!("{now}, for {lost} is lost: {why}"));
                    self.active = Box::new(spare);
                }
                self.active.render(placements, cameras, images)
            }
            rendered => rendered,
        }
    }

    fn workload(&self) -> Workload {
        self.active.workload()
    }
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};
    use vizflyt_protocol::geometry::{Intrinsics, Pose};

    use super::*;
    use crate::Splats;

    /// Renders `left` images through another renderer, then fails as a lost device.
    struct Failing {
        inner: CpuRenderer,
        left: usize,
    }

    impl Rasterizer for Failing {
        fn name(&self) -> Cow<'_, str> {
            "gpu of glass".into()
        }

        fn render(
            &mut self,
            placements: &[Placement],
            cameras: &[Camera],
            images: &mut [RgbdImage],
        ) -> Result<PassTimes, RenderError> {
            let Some(left) = self.left.checked_sub(1) else {
                for image in images.iter_mut() {
                    image.resize(3, 3);
                }
                return Err(RenderError::Device("it broke".into()));
            };
            self.left = left;
            self.inner.render(placements, cameras, images)
        }

        fn workload(&self) -> Workload {
            self.inner.workload()
        }
    }

    #[test]
    fn no_image_is_missing_when_the_device_is_lost() {
        let splats = Splats {
            means_m: vec![Vec3::new(0.0, 0.0, 2.0)],
            scales_m: vec![Vec3::splat(0.3)],
            rotations: vec![Quat::IDENTITY],
            opacities: vec![0.9],
            sh_degree: 0,
            sh: vec![0.1, 0.2, 0.3],
            antialiased: false,
        };
        let camera =
            Camera::new(Intrinsics::from_horizontal_fov(32, 24, 1.2), Pose::IDENTITY, 0.01);
        let failing = Failing { inner: CpuRenderer::new(&splats), left: 2 };
        let mut fallback = FallbackRenderer::new(Box::new(failing), CpuRenderer::new(&splats));
        let mut images = Vec::new();
        for i in 0..5 {
            let is_lost = fallback.name() != "gpu of glass";
            assert_eq!(is_lost, i > 2, "{}", fallback.name());
            let mut image = [RgbdImage::default()];
            fallback.render(&[], &[camera], &mut image).expect("an image");
            images.extend(image);
        }
        assert!(images.iter().all(|image| *image == images[0]));
        assert!(images[0].alpha[12 * 32 + 16] > 0.8);
        assert!(fallback.name().starts_with("cpu "), "{}", fallback.name());
        assert!(fallback.name().ends_with("for gpu of glass is lost: it broke"));
        assert_eq!(fallback.workload().splats, 1);
        // An error that is not the device's stays an error.
        let bad = Camera { near_m: f32::NAN, ..camera };
        let refused = fallback.render(&[], &[bad], &mut [RgbdImage::default()]);
        assert!(matches!(refused, Err(RenderError::Camera(_))));
    }
}
