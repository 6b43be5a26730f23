//! All renderers behind one interface, so that each check is written once.

use std::borrow::Cow;

use vizflyt_splat::{
    Camera, CpuRenderer, PassTimes, Placement, Rasterizer, RenderError, RgbdImage, RigidObject,
    Scene, Splats, Workload, render_reference,
};

/// Packs a scene for several renderers. A check with this parameter can be used for any of them.
pub(crate) type Make<'a> = &'a dyn Fn(Scene<'_>) -> Vec<Box<dyn Rasterizer>>;

/// Reference renderer as a [`Rasterizer`].
struct Reference {
    splats: Splats,
    objects: Vec<RigidObject>,
}

impl Rasterizer for Reference {
    fn name(&self) -> Cow<'_, str> {
        "reference".into()
    }

    fn render(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
        images: &mut [RgbdImage],
    ) -> Result<PassTimes, RenderError> {
        let scene = Scene { splats: &self.splats, objects: &self.objects };
        for (camera, image) in cameras.iter().zip(images) {
            *image = render_reference(scene, placements, camera)?;
        }
        Ok(PassTimes::default())
    }

    fn workload(&self) -> Workload {
        Workload { splats: self.splats.len(), ..Workload::default() }
    }
}

/// Returns only the reference.
pub(crate) fn reference(scene: Scene<'_>) -> Vec<Box<dyn Rasterizer>> {
    vec![Box::new(Reference { splats: scene.splats.clone(), objects: scene.objects.to_vec() })]
}

/// Returns the CPU renderer of every instruction set.
pub(crate) fn cpus(scene: Scene<'_>) -> Vec<Box<dyn Rasterizer>> {
    CpuRenderer::every(scene).into_iter().map(|cpu| Box::new(cpu) as Box<dyn Rasterizer>).collect()
}

/// Returns the reference and every CPU renderer.
pub(crate) fn every(scene: Scene<'_>) -> Vec<Box<dyn Rasterizer>> {
    let mut all = reference(scene);
    all.extend(cpus(scene));
    all
}
