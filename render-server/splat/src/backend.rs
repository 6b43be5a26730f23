//! Choice of the renderer for a machine, with the reason. Made once at the start, printed and shown on the page.

use std::str::FromStr;

#[cfg(feature = "gpu")]
use crate::gpu;
use crate::{CpuRenderer, Detail, FallbackRenderer, Rasterizer, Scene};

/// Requested kind of renderer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Backend {
    /// Graphics card if one is available and renders a test image as the processor does, else the processor. Software
    /// Vulkan is skipped.
    #[default]
    Auto,
    /// Processor.
    Cpu,
    /// Any graphics adapter, including software Vulkan.
    Gpu,
}

impl FromStr for Backend {
    type Err = UnknownBackend;

    fn from_str(name: &str) -> Result<Self, UnknownBackend> {
        match name {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu),
            _ => Err(UnknownBackend(name.to_owned())),
        }
    }
}

/// Unknown name of a backend.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown renderer {0:?}; choose auto, cpu or gpu")]
pub struct UnknownBackend(String);

/// Chosen renderer with the reason.
pub struct Chosen {
    /// Renderer with its own packed copy of the scene.
    pub rasterizer: Box<dyn Rasterizer>,
    /// Reason of the choice, as text: `no graphics adapter`.
    pub reason: String,
}

impl std::fmt::Debug for Chosen {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Chosen").field(&self.rasterizer.name()).field(&self.reason).finish()
    }
}

/// The requested renderer is not available.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoRenderer {
    /// The GPU was requested, but no adapter can be used.
    #[error("no graphics adapter can be used: {0}; choose cpu or auto")]
    Gpu(String),
}

/// Returns the renderer for a scene on this machine. A renderer on a graphics card gets the processor as fallback
/// ([`crate::FallbackRenderer`]) in the same detail, so that no image is missing if the device is lost.
///
/// # Errors
/// [`NoRenderer::Gpu`] if [`Backend::Gpu`] was requested and no adapter can be used. The other backends never fail.
pub fn choose<'a>(
    scene: impl Into<Scene<'a>>,
    backend: Backend,
    detail: Detail,
) -> Result<Chosen, NoRenderer> {
    let cpu = CpuRenderer::with_detail(scene, detail);
    if backend == Backend::Cpu {
        return Ok(Chosen { rasterizer: Box::new(cpu), reason: "asked for".to_owned() });
    }
    match (graphics(&cpu, backend == Backend::Gpu), backend) {
        (Ok((rasterizer, reason)), _) => {
            Ok(Chosen { rasterizer: Box::new(FallbackRenderer::new(rasterizer, cpu)), reason })
        }
        (Err(why), Backend::Gpu) => Err(NoRenderer::Gpu(why)),
        (Err(reason), _) => Ok(Chosen { rasterizer: Box::new(cpu), reason }),
    }
}

/// Returns a renderer on the first adapter that renders the test image, and a description of all adapters tried; or
/// why no adapter can be used.
#[cfg(feature = "gpu")]
fn graphics(
    packed: &CpuRenderer,
    takes_software: bool,
) -> Result<(Box<dyn Rasterizer>, String), String> {
    let mut found = Vec::new();
    for adapter in gpu::Adapter::all() {
        let gpu::AdapterName { name, is_software } = adapter.name();
        if *is_software && !takes_software {
            found.push(format!("software adapter {name} left alone"));
            continue;
        }
        let kind = if *is_software { "software adapter" } else { "graphics adapter" };
        let opened = trial::scene_and_camera();
        let rendered = gpu::GpuRenderer::new(&opened.0, &adapter, gpu::Budget::default())
            .map_err(|error| error.to_string())
            .and_then(|mut renderer| {
                let found_db = trial::check(&mut renderer, &opened.0, &opened.1)?;
                renderer.load(packed).map_err(|error| error.to_string())?;
                Ok((renderer, found_db))
            });
        match rendered {
            Ok((renderer, found_db)) => {
                found
                    .push(format!("{kind} {name} renders as the processor does, {found_db:.0} dB"));
                return Ok((Box::new(renderer), found.join("; ")));
            }
            Err(why) => found.push(format!("{kind} {name} refused: {why}")),
        }
    }
    Err(if found.is_empty() { "no graphics adapter".to_owned() } else { found.join("; ") })
}

#[cfg(not(feature = "gpu"))]
fn graphics(_: &CpuRenderer, _: bool) -> Result<(Box<dyn Rasterizer>, String), String> {
    Err("built without the feature `gpu`".to_owned())
}

/// Test image: some drivers sort incorrectly or render nothing.
#[cfg(feature = "gpu")]
mod trial {
    use glam::{Quat, Vec3};
    use vizflyt_protocol::geometry::{Intrinsics, Pose};

    use crate::{Camera, CpuRenderer, Rasterizer, RgbdImage, Splats};

    /// Minimum similarity; a lower value is not a rounding error. Correct renderers agree to 75 dB and more.
    const MIN_DB: f64 = 50.0;

    /// Returns 20 k splats in many layers, more than one group of the sort holds, and a camera that sees most of
    /// them.
    pub(super) fn scene_and_camera() -> (Splats, Camera) {
        let mut splats = Splats { sh_degree: 1, ..Splats::default() };
        for i in 0..20_000u32 {
            // Low-discrepancy numbers (Roberts 2018, R3): evenly spread, without a pattern.
            let r = |share: f64, i: u32| (0.5 + share * f64::from(i)).fract() as f32;
            let (x, y, z) = (r(0.819_172_5, i), r(0.671_043_6, i), r(0.549_700_5, i));
            splats.means_m.push(Vec3::new(x * 4.0 - 2.0, y * 3.0 - 1.5, 1.0 + 3.0 * z));
            splats.scales_m.push(Vec3::new(0.01 + 0.04 * y, 0.01 + 0.04 * z, 0.01 + 0.04 * x));
            let axis = Vec3::new(x - 0.5, y - 0.5, z - 0.5).normalize_or(Vec3::X);
            splats.rotations.push(Quat::from_axis_angle(axis, 6.0 * y));
            splats.opacities.push(0.05 + 0.9 * x);
            splats.sh.extend((0..12).map(|k| r(0.137, i + k) - 0.5));
        }
        let camera = Camera {
            background: [0.1, 0.2, 0.3],
            ..Camera::new(Intrinsics::from_horizontal_fov(100, 75, 1.3), Pose::IDENTITY, 0.05)
        };
        (splats, camera)
    }

    /// Renders the test image twice, and returns its similarity to the processor's image [dB]; or the error.
    pub(super) fn check(
        renderer: &mut dyn Rasterizer,
        splats: &Splats,
        camera: &Camera,
    ) -> Result<f64, String> {
        let mut expected = [RgbdImage::default()];
        let mut cpu = CpuRenderer::new(splats);
        cpu.render(&[], &[*camera], &mut expected).map_err(|error| error.to_string())?;
        let mut images = [RgbdImage::default(), RgbdImage::default()];
        for image in images.chunks_mut(1) {
            renderer.render(&[], &[*camera], image).map_err(|error| error.to_string())?;
        }
        if images[0] != images[1] {
            return Err("renders the same test image differently each time".to_owned());
        }
        let found_db = alike_db(&images[0], &expected[0]);
        // Written so that NaN is rejected.
        if found_db >= MIN_DB {
            Ok(found_db)
        } else {
            Err(format!("renders the test image {found_db:.0} dB from the processor's"))
        }
    }

    /// Returns the minimum peak signal-to-noise ratio of colour, alpha and expected depth; depth relative to 4 m.
    /// [dB]
    fn alike_db(a: &RgbdImage, b: &RgbdImage) -> f64 {
        let db = |a: &[f32], b: &[f32], peak: f64| {
            let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
            let mean = sum / a.len() as f64;
            10.0 * (peak * peak / mean.max(1e-20)).log10()
        };
        db(&a.rgb, &b.rgb, 1.0).min(db(&a.alpha, &b.alpha, 1.0)).min(db(
            &a.depth_expected_m,
            &b.depth_expected_m,
            4.0,
        ))
    }

    #[cfg(test)]
    mod tests {
        use std::borrow::Cow;

        use super::*;
        use crate::{PassTimes, Placement, RenderError, Workload};

        /// Renders like the processor, then corrupts the image.
        struct Spoiling(CpuRenderer, fn(&mut RgbdImage, usize), usize);

        impl Rasterizer for Spoiling {
            fn name(&self) -> Cow<'_, str> {
                "".into()
            }

            fn render(
                &mut self,
                placements: &[Placement],
                cameras: &[Camera],
                images: &mut [RgbdImage],
            ) -> Result<PassTimes, RenderError> {
                let rendered = self.0.render(placements, cameras, images);
                self.1(&mut images[0], self.2);
                self.2 += 1;
                rendered
            }

            fn workload(&self) -> Workload {
                Workload::default()
            }
        }

        #[test]
        fn rejects_wrong_and_unstable_images() {
            let (splats, camera) = scene_and_camera();
            let check = |spoil: fn(&mut RgbdImage, usize), part: &str| {
                let mut renderer = Spoiling(CpuRenderer::new(&splats), spoil, 0);
                let reason = match check(&mut renderer, &splats, &camera) {
                    Ok(found_db) => format!("{found_db} dB"),
                    Err(why) => why,
                };
                assert!(reason.contains(part), "{reason:?} lacks {part:?}");
            };
            check(|_, _| (), "200 dB");
            check(|image, _| image.rgb[777] += 1e-3, " dB");
            check(|image, _| image.rgb.fill(0.0), "from the processor's");
            check(|image, _| image.alpha[4000] = f32::NAN, "differently each time");
            check(|image, _| image.alpha[4000] = f32::INFINITY, "from the processor's");
            check(|image, _| image.depth_expected_m.fill(1.0), "from the processor's");
            check(|image, i| image.rgb[5] = i as f32 * 1e-6, "differently each time");
        }
    }
}
