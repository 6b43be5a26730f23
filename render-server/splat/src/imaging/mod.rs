//! Realistic cameras: applies the effects of a sensor to a perfect rendered image, in place.
//!
//! ```text
//! perfect RgbdImage --> Imager::apply --> image of the camera
//!   colour  display colours -> linear light [`tone`] -> exposure, fixed or automatic [`exposure`]
//!           -> path of each row during its exposure [`shutter`] -> electrons, noise, numbers [`noise`]
//!           -> mosaic, denoising [`mosaic`] -> display colours
//!   depth   measured by a stereo pair [`stereo`] or a time-of-flight camera [`tof`]
//! ```
//! The result depends only on (image, model, path, key, time since the last image) and on the state of the exposure.
//! It is bit-identical for any number of threads. Callers are the server's render thread and graded flights, once per
//! image. Buffers are reused, so nothing is allocated after they have grown. Limited by arithmetic: about 30 ns per
//! pixel and core with all effects.
//!
//! An event camera ([`events`]) is a separate sensor: its input is a sequence of images.

pub mod events;
pub mod exposure;
pub mod mosaic;
pub mod noise;
pub mod shutter;
pub mod stereo;
pub mod tof;
pub mod tone;

use std::sync::LazyLock;

use glam::Vec2;
use rayon::prelude::*;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use self::exposure::{Exposure, ExposureControl, Follow, vignetting};
use self::mosaic::{ColorFilter, bayer_color, demosaic_row, denoise_row};
use self::noise::{NoiseKey, Normals, Readout};
use self::shutter::{Moved, Pixel, Seen};
use self::stereo::Stereo;
use self::tof::Tof;
use self::tone::{Tone, luminance};
use crate::{Camera, RgbdImage};

/// Sensor effects of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraModel {
    /// Colour sensor; `None` is a perfect one.
    pub sensor: Option<Sensor>,
    /// Depth sensor.
    pub depth: DepthModel,
}

/// Measurement principle of depth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum DepthModel {
    /// True depth.
    #[default]
    Perfect,
    /// Stereo pair.
    Stereo(Stereo),
    /// Time of flight.
    Tof(Tof),
}

/// Image sensor behind its lens. All values are per pixel of the image: if it combines `n` pixels of the sensor,
/// electrons and full well are their sums, and read noise is `sqrt(n)` times that of one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Full well capacity of a pixel. [e]
    pub full_well_e: f64,
    /// Read noise of a pixel, standard deviation. [e]
    pub read_noise_e: f64,
    /// Electrons per second for linear light of 1, the brightest light in the scene's file. [e/s]
    pub electrons_per_s: f64,
    /// Resolution of the converter, 8 to 16 bits.
    pub bits: u32,
    /// Colour filter in front of the pixels.
    pub filter: ColorFilter,
    /// Whether images are denoised.
    pub denoise: bool,
    /// Whether photon noise and read noise are added.
    pub noise: bool,
    /// Relative loss of light in the corners, 0 to 1.
    pub vignette: f64,
    /// Time from the first row's exposure to the last one's; 0 is a global shutter. [s]
    pub readout_s: f64,
    /// Control of shutter and gain.
    pub exposure: ExposureControl,
}

/// Pose of a camera at a time relative to the instant of its image. [s]
pub type Path<'a> = dyn Fn(f64) -> Pose<World, Cam> + Sync + 'a;

/// One image to be taken.
#[derive(Clone, Copy)]
pub struct Shot<'a> {
    /// Camera of the rendered image, at the middle of the middle row's exposure.
    pub camera: &'a Camera,
    /// Path of the camera around that instant.
    pub path: &'a Path<'a>,
    /// Instant of the image, on a clock that is common to all images. [s]
    pub at_s: f64,
    /// Key of the random noise.
    pub key: NoiseKey,
}

/// State of one camera: its exposure, and buffers.
#[derive(Debug, Default)]
pub struct Imager {
    follow: Follow,
    last_s: Option<f64>,
    lens: Option<Intrinsics>,
    pixels: Vec<Pixel>,
    /// Linear light of the rendered image, H x W x 3.
    light: Vec<f32>,
    /// Linear light that each row collects, H x W x 3; then its digitised values.
    exposed: Vec<f32>,
    /// Digitised values of a mosaic, H x W.
    mosaic: Vec<f32>,
    denoised: Vec<f32>,
    depth: Vec<f32>,
    stereo: stereo::Scratch,
    tof: tof::Scratch,
}

impl Imager {
    /// Converts a perfect image to that of the camera. Returns its exposure. Measured depth is written to both depths
    /// of the image, in whole millimetres, with alpha 1 where there is a return; ids stay those of the perfect image.
    ///
    /// # Panics
    /// If the image does not have the camera's size.
    pub fn apply(
        &mut self,
        model: &CameraModel,
        shot: &Shot<'_>,
        image: &mut RgbdImage,
    ) -> Option<Exposure> {
        if *model == CameraModel::default() {
            return None;
        }
        self.prepare(shot.camera, image);
        let is_measured = self.measure_depth(&model.depth, shot, image);
        let exposure = model.sensor.map(|sensor| self.take(&sensor, shot, image));
        if is_measured {
            for (alpha, &depth_m) in image.alpha.iter_mut().zip(&self.depth) {
                // Depth that is fattened over empty space is also a return.
                *alpha = if depth_m > 0.0 { 1.0 } else { *alpha };
            }
            image.depth_expected_m.copy_from_slice(&self.depth);
            image.depth_median_m.copy_from_slice(&self.depth);
        }
        exposure
    }

    /// Resizes the buffers, and recomputes values that depend on the lens only if it has changed.
    fn prepare(&mut self, camera: &Camera, image: &RgbdImage) {
        let k = &camera.intrinsics;
        assert_eq!((image.width_px, image.height_px), (k.width_px, k.height_px));
        if self.lens != Some(*k) {
            self.pixels = shutter::pixels(k);
            self.lens = Some(*k);
        }
        let count = k.pixels();
        self.light.resize(3 * count, 0.0);
        self.exposed.resize(3 * count, 0.0);
        self.mosaic.resize(count, 0.0);
        self.denoised.resize(3 * count, 0.0);
        self.depth.resize(count, 0.0);
        let tone = tone();
        let wide = 3 * k.width_px as usize;
        self.light.par_chunks_mut(wide).zip(image.rgb.par_chunks(wide)).for_each(|(light, rgb)| {
            for (light, &shown) in light.iter_mut().zip(rgb) {
                *light = tone.linear(shown);
            }
        });
    }

    /// Measures depth into `self.depth`. Returns `false` for perfect depth, which is not written.
    fn measure_depth(&mut self, model: &DepthModel, shot: &Shot<'_>, image: &RgbdImage) -> bool {
        let k = &shot.camera.intrinsics;
        match model {
            DepthModel::Perfect => return false,
            DepthModel::Stereo(stereo) => {
                let key = shot.key.stream(1);
                stereo.measure(k, image, &self.light, key, &mut self.stereo, &mut self.depth);
            }
            DepthModel::Tof(tof) => {
                let (key, light) = (shot.key.stream(2), &self.light);
                let (pixels, scratch) = (&self.pixels, &mut self.tof);
                tof.measure(k, image, (pixels, light), key, scratch, &mut self.depth);
            }
        }
        true
    }

    /// Takes the colour image.
    fn take(&mut self, sensor: &Sensor, shot: &Shot<'_>, image: &mut RgbdImage) -> Exposure {
        let k = &shot.camera.intrinsics;
        let (width, height) = (k.width_px as usize, k.height_px as usize);
        let full_s = sensor.full_well_e / sensor.electrons_per_s;
        let dt_s = self.last_s.map_or(0.0, |last_s| shot.at_s - last_s);
        self.last_s = Some(shot.at_s);
        let mean = mean_light(&self.light);
        let exposure = sensor.exposure.next(&mut self.follow, mean, full_s, dt_s);
        let readout = sensor.readout(&exposure);
        // A single row or column cannot be interpolated.
        let is_line = width < 2 || height < 2;
        let filter = if is_line { ColorFilter::Rgb } else { sensor.filter };

        let seen =
            Seen::new((k.width_px, k.height_px), &self.light, &image.depth_median_m, Vec2::ZERO);
        let rendered_from_world = shot.camera.world_from_cam.inverse();
        let moved = |at_s| Moved::new(rendered_from_world * (shot.path)(at_s));
        let (pixels, light) = (&self.pixels, &self.light);
        let vignette = sensor.vignette as f32;
        let rows = RowReader { readout: &readout, vignette, filter, key: shot.key, width, height };
        let lines = self.exposed.par_chunks_mut(3 * width);
        lines.zip(self.mosaic.par_chunks_mut(width)).enumerate().for_each(|(y, (line, mosaic))| {
            let middle_s = ((y as f64 + 0.5) / height as f64 - 0.5) * sensor.readout_s;
            let half_s = exposure.shutter_s / 2.0;
            let ends = [middle_s - half_s, middle_s + half_s].map(moved);
            if is_line {
                line.copy_from_slice(&light[3 * y * width..][..3 * width]);
            } else {
                line.fill(0.0);
                seen.expose_row(&pixels[y * width..][..width], y, ends, line);
            }
            rows.read(y, line, mosaic);
        });
        let mut raw = if filter == ColorFilter::Rgb { &self.exposed } else { &self.mosaic };
        if sensor.denoise {
            let wide = filter.channels() * width;
            let rows = self.denoised[..wide * height].par_chunks_mut(wide).enumerate();
            rows.for_each(|(y, out)| denoise_row(raw, (width, height), filter, &readout, y, out));
            raw = &self.denoised;
        }
        let tone = tone();
        let show = |value: f32| f32::from(tone.shown(value)) / 255.0;
        image.rgb.par_chunks_mut(3 * width).enumerate().for_each(|(y, out)| {
            match filter {
                ColorFilter::Rgb => out.copy_from_slice(&raw[3 * y * width..][..3 * width]),
                ColorFilter::Bayer => demosaic_row(&raw[..width * height], width, y, out),
                ColorFilter::Mono => {
                    for (out, &value) in out.chunks_exact_mut(3).zip(&raw[y * width..][..width]) {
                        out.fill(value);
                    }
                }
            }
            for value in out {
                *value = show(*value);
            }
        });
        exposure
    }
}

impl Sensor {
    fn readout(&self, exposure: &Exposure) -> Readout {
        let full_scale = ((1u64 << self.bits.clamp(1, 24)) - 1) as f64;
        Readout {
            electrons: (self.electrons_per_s * exposure.shutter_s) as f32,
            full_well_e: self.full_well_e as f32,
            read_noise_e: self.read_noise_e as f32,
            numbers_per_e: (exposure.gain * full_scale / self.full_well_e) as f32,
            full_scale: full_scale as f32,
            amount: f32::from(u8::from(self.noise)),
        }
    }
}

/// Digitises light, row by row.
struct RowReader<'a> {
    readout: &'a Readout,
    vignette: f32,
    filter: ColorFilter,
    key: NoiseKey,
    /// Size of the image [px].
    width: usize,
    height: usize,
}

impl RowReader<'_> {
    /// Digitises row `y` of light, in place or into its row of the mosaic.
    fn read(&self, y: usize, line: &mut [f32], mosaic: &mut [f32]) {
        let table = Normals::table();
        let &Self { readout, vignette, filter, key, width, height } = self;
        let v = (y as f32 + 0.5) / height as f32 - 0.5;
        for (x, (light, mosaic)) in line.chunks_exact_mut(3).zip(mosaic).enumerate() {
            let bright = vignetting(vignette, (x as f32 + 0.5) / width as f32 - 0.5, v);
            let bits = key.bits(y * width + x);
            match filter {
                ColorFilter::Rgb => {
                    for (c, light) in (0u32..).zip(light) {
                        *light = readout.read(bright * *light, table.of(bits, c));
                    }
                }
                ColorFilter::Bayer => {
                    *mosaic = readout.read(bright * light[bayer_color(x, y)], table.of(bits, 0));
                }
                ColorFilter::Mono => {
                    let light = luminance(light[0], light[1], light[2]);
                    *mosaic = readout.read(bright * light, table.of(bits, 0));
                }
            }
        }
    }
}

/// Returns the mean luminance of every [`METERED`]th pixel.
fn mean_light(light: &[f32]) -> f64 {
    let (mut sum, mut count) = (0.0, 0u32);
    for rgb in light.chunks_exact(3).step_by(METERED) {
        sum += f64::from(luminance(rgb[0], rgb[1], rgb[2]));
        count += 1;
    }
    sum / f64::from(count.max(1))
}

/// Returns the tone tables: 80 kB, created once.
fn tone() -> &'static Tone {
    static TONE: LazyLock<Tone> = LazyLock::new(Tone::default);
    &TONE
}

/// Step between metered pixels. Prime, so that all columns of an image are sampled.
const METERED: usize = 31;

#[cfg(test)]
mod tests;
