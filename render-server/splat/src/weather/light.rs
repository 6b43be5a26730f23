//! Lamps, the vehicle's own light and flicker: gain of surface colours relative to the light of the
//! scene.
//!
//! The square of a display value is taken as light (the sRGB curve differs by at most 0.04). A
//! surface receives a share `l` of the capture's light, and `e` times that light from lamps. It is
//! displayed as `c sqrt(l² + e)`, if `c` is its value in the capture. Light falls off with the
//! square of the distance. Lamps cast no shadows and light surfaces from any side, because a scene
//! of splats has no reliable normals.

use glam::{DVec3, Mat3, Vec3};

use super::flicker::Flicker;
use crate::{Atmosphere, Camera};

/// Lamps in the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lamps {
    /// Distance from a lamp at which its light equals that of the capture. [m]
    pub reach_m: f32,
    /// Colour: red, green, blue; 1 is that of the capture.
    pub color: [f32; 3],
    /// Positions of the lamps.
    pub places: LampPlaces,
}

/// Positions of lamps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LampPlaces {
    /// Lamps at one height, on a square grid through the origin. [m, world]
    Grid {
        /// Height of the lamps. [m, world]
        height_m: f32,
        /// Distance between neighbouring lamps. [m]
        spacing_m: f32,
    },
    /// Single lamps; NaN is an unused entry. [m, world]
    At([DVec3; MAX_LAMPS]),
}

/// Maximum number of single lamps.
pub const MAX_LAMPS: usize = 8;

/// Light next to each camera that shines along the camera's axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnLight {
    /// Distance ahead at which the light equals that of the capture. [m]
    pub reach_m: f32,
    /// Colour: red, green, blue; 1 is that of the capture.
    pub color: [f32; 3],
    /// Cosine of the half angle of the cone; at its border, the light is half as bright.
    pub cos_cone: f32,
}

/// Distance below which a lamp does not get brighter: the size of a lamp with its shade. [m]
const LAMP_SIZE_M: f32 = 0.3;
/// Half width of the soft border of the own light's cone, in units of the cosine.
const CONE_SOFT: f32 = 0.06;
/// Minimum light of a scene for lamps. Colours of darker scenes cannot be recovered.
pub const LEAST_LIGHT: f32 = 0.02;

/// All light of one image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Illumination {
    /// Lamps, and their positions relative to the camera. [m, world]
    lamps: Option<(Lamps, [Vec3; MAX_LAMPS])>,
    own: Option<OwnLight>,
    /// Light of a lamp relative to that of the scene, per channel.
    lamp_share: [f32; 3],
    own_share: [f32; 3],
    world_from_cam: Mat3,
    camera_m: Vec3,
    atmosphere: Atmosphere,
}

impl Illumination {
    pub(super) fn new(lamps: Option<Lamps>, own: Option<OwnLight>, camera: &Camera) -> Self {
        let center_m = camera.world_from_cam.translation_m;
        let offsets = lamps.map(|lamps| {
            let offsets_m = match lamps.places {
                LampPlaces::At(places) => places.map(|place_m| (place_m - center_m).as_vec3()),
                LampPlaces::Grid { .. } => [Vec3::NAN; MAX_LAMPS],
            };
            (lamps, offsets_m)
        });
        let light = camera.atmosphere.light;
        let share = |color: Option<[f32; 3]>| {
            let color = color.unwrap_or_default();
            [0, 1, 2].map(|c| color[c] / (light[c] * light[c]).max(LEAST_LIGHT * LEAST_LIGHT))
        };
        Self {
            lamps: offsets,
            own,
            lamp_share: share(lamps.map(|lamps| lamps.color)),
            own_share: share(own.map(|own| own.color)),
            world_from_cam: Mat3::from_quat(camera.world_from_cam.rotation.as_quat()),
            camera_m: center_m.as_vec3(),
            atmosphere: camera.atmosphere,
        }
    }

    /// Returns the gain of a colour at a position [m, cam], if the light of the scene is `flicker`
    /// times its mean.
    #[inline]
    pub(super) fn gain(&self, p_cam_m: Vec3, flicker: f32) -> [f32; 3] {
        let lamps = self.lamps.as_ref().map_or(0.0, |lamps| self.of_lamps(lamps, p_cam_m));
        let own = self.own.as_ref().map_or(0.0, |own| {
            let distance_m = p_cam_m.length();
            of_own(own, distance_m, p_cam_m.z / distance_m.max(1e-6))
        });
        self.gain_in(lamps, own, flicker)
    }

    #[inline]
    fn of_lamps(&self, (lamps, offsets_m): &(Lamps, [Vec3; MAX_LAMPS]), p_cam_m: Vec3) -> f32 {
        let offset_m = self.world_from_cam * p_cam_m;
        let square = lamps.reach_m * lamps.reach_m;
        let of = |distance_squared: f32| square / distance_squared.max(LAMP_SIZE_M * LAMP_SIZE_M);
        match lamps.places {
            LampPlaces::Grid { height_m, spacing_m } => {
                let p_m = self.camera_m + offset_m;
                // The four nearest lamps of the grid: the nearest and the next along each axis.
                let nearest = |x_m: f32| {
                    let cells = x_m / spacing_m;
                    let off_m = (cells - ((cells + ROUND) - ROUND)) * spacing_m;
                    let other_m = spacing_m - off_m.abs();
                    [off_m * off_m, other_m * other_m]
                };
                let (x, y) = (nearest(p_m.x), nearest(p_m.y));
                let z = (p_m.z - height_m) * (p_m.z - height_m);
                of(x[0] + y[0] + z)
                    + of(x[1] + y[0] + z)
                    + of(x[0] + y[1] + z)
                    + of(x[1] + y[1] + z)
            }
            LampPlaces::At(_) => {
                let light = |lamp_m: &Vec3| {
                    let light = of((*lamp_m - offset_m).length_squared());
                    // The comparison is false for NaN: an unused entry.
                    if lamp_m.x < f32::INFINITY { light } else { 0.0 }
                };
                offsets_m.iter().map(light).sum()
            }
        }
    }

    /// Lights a row of pixels. `z_m` is the depth of each pixel's surface [m, cam]. The last two
    /// slices are scratch memory.
    pub(super) fn light_row(
        &self,
        [sx, sy, norm, z_m]: [&[f32]; 4],
        [of_lamps, of_own_light]: [&mut [f32]; 2],
        flicker: f32,
        rgb: &mut [f32],
    ) {
        if self.lamps.is_none() && self.own.is_none() {
            let gain = flicker.sqrt();
            for value in rgb {
                *value *= gain;
            }
            return;
        }
        of_lamps.fill(0.0);
        of_own_light.fill(0.0);
        if let Some(lamps) = &self.lamps {
            for (((light, &sx), &sy), &z_m) in of_lamps.iter_mut().zip(sx).zip(sy).zip(z_m) {
                *light = self.of_lamps(lamps, Vec3::new(sx, sy, 1.0) * z_m);
            }
        }
        if let Some(own) = &self.own {
            for ((light, &norm), &z_m) in of_own_light.iter_mut().zip(norm).zip(z_m) {
                *light = of_own(own, z_m * norm, 1.0 / norm);
            }
        }
        let Atmosphere { fog_per_m, fog, .. } = self.atmosphere;
        let lights = of_lamps.iter().zip(&*of_own_light);
        if fog_per_m > 0.0 {
            let on_fog = flicker.sqrt();
            let depths = norm.iter().zip(z_m);
            for ((rgb, (&lamps, &own)), (&norm, &z_m)) in
                rgb.chunks_exact_mut(3).zip(lights).zip(depths)
            {
                let gain = self.gain_in(lamps, own, flicker);
                // The part of the colour that is fog in front of the surface receives only the
                // scene's light.
                let hidden = 1.0 - super::exp::exp_neg(fog_per_m * z_m * norm);
                for c in 0..3 {
                    let veil = fog[c] * hidden;
                    rgb[c] = veil * on_fog + (rgb[c] - veil) * gain[c];
                }
            }
        } else {
            for (rgb, (&lamps, &own)) in rgb.chunks_exact_mut(3).zip(lights) {
                let gain = self.gain_in(lamps, own, flicker);
                for c in 0..3 {
                    rgb[c] *= gain[c];
                }
            }
        }
    }

    /// Returns the gain, given the light of the lamps and of the vehicle.
    #[inline]
    fn gain_in(&self, lamps: f32, own: f32, flicker: f32) -> [f32; 3] {
        [0, 1, 2].map(|c| {
            (flicker * (1.0 + lamps * self.lamp_share[c]) + own * self.own_share[c]).sqrt()
        })
    }
}

/// Returns the own light at a distance [m] and at the cosine of an angle from its axis.
#[inline]
fn of_own(own: &OwnLight, distance_m: f32, cos: f32) -> f32 {
    let square = (distance_m * distance_m).max(LAMP_SIZE_M * LAMP_SIZE_M);
    let within = ((cos - own.cos_cone) * (0.5 / CONE_SOFT) + 0.5).clamp(0.0, 1.0);
    own.reach_m * own.reach_m / square * within
}

/// 1.5 * 2^23: adding it to a number rounds off the fraction.
const ROUND: f32 = 12_582_912.0;

/// Flicker of the light at one instant, row by row.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowLight {
    pub(super) flicker: Option<Flicker>,
    pub(super) at_ns: i64,
    pub(super) exposure_s: f32,
    pub(super) height: usize,
}

impl RowLight {
    /// Returns the light of a row as a share of its mean.
    pub(super) fn of(&self, y: usize) -> f32 {
        let of_row = |flicker: Flicker| flicker.of_row(self.at_ns, self.exposure_s, y, self.height);
        self.flicker.map_or(1.0, of_row)
    }
}
