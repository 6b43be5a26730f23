//! Predefined models of an arena by name, so that a course can be set up without a modelling program.
//!
//! ```text
//! models/gate-120x100.ply           frame, opening 120 x 100 cm; x is the flight direction, the origin its middle
//! models/gate-120x100-blue.ply      in another colour: orange, blue, green, white
//! models/box-40x40x180.ply          a box of 40 x 40 x 180 cm, standing on the origin
//! models/quadrotor.ply              a small quadrotor, its nose along x
//! ```

use glam::Vec3;
use vizflyt_splat::Splats;
use vizflyt_splat::builtin_models::{Part, QUADROTOR, boxes, boxes_in_patches};

/// Returns the splats of the model with this file name; `None` if the name is not one of a model. [m, object]
///
/// ```
/// use vizflyt_server::scene::model;
/// let gate = model("models/gate-120x100.ply").unwrap();
/// assert!(gate.means_m.iter().all(|p| p.y.abs() > 0.59 || p.z.abs() > 0.49));
/// assert!(model("models/gate-9000x1.ply").is_none() && model("table.ply").is_none());
/// ```
pub fn model(file: &str) -> Option<Splats> {
    let name = file.strip_prefix("models/")?.strip_suffix(".ply")?;
    if name == "quadrotor" {
        return Some(boxes(&QUADROTOR));
    }
    let mut words = name.split('-');
    let (kind, size) = (words.next()?, words.next()?);
    let (first, second) = colours(words.next().unwrap_or("orange"))?;
    if words.next().is_some() {
        return None;
    }
    let sides_cm: Vec<u16> = size.split('x').map(str::parse).collect::<Result<_, _>>().ok()?;
    let is_sound = sides_cm.iter().all(|side_cm| (5..=1000).contains(side_cm));
    let sides_m: Vec<f32> = sides_cm.iter().map(|&side_cm| f32::from(side_cm) / 100.0).collect();
    match (kind, sides_m.as_slice(), is_sound) {
        ("gate", &[width_m, height_m], true) => {
            Some(boxes_in_patches(&gate(width_m, height_m, first, second), PATCH_M))
        }
        ("box", &[x_m, y_m, z_m], true) => {
            let (half_m, colour) = (Vec3::new(x_m, y_m, z_m) / 2.0, first);
            let patch_m = PATCH_M.max(half_m.max_element() / 25.0);
            let center_m = Vec3::Z * half_m.z;
            Some(boxes_in_patches(&[Part { center_m, half_m, colour }], patch_m))
        }
        _ => None,
    }
}

/// Returns four bars around an opening, striped so that a rotation is visible, with blocks at the corners.
fn gate(width_m: f32, height_m: f32, first: [f32; 3], second: [f32; 3]) -> Vec<Part> {
    let mut parts = Vec::new();
    let bars = [(Vec3::Y, width_m, height_m, Vec3::Z), (Vec3::Z, height_m, width_m, Vec3::Y)];
    for (along, length_m, apart_m, across) in bars {
        for side in [-1.0, 1.0] {
            let middle_m = across * side * (apart_m + BAR_M) / 2.0;
            let bands = (length_m / BAND_M).round().max(1.0);
            let half_m = Vec3::splat(BAR_M / 2.0) + along * (length_m / bands / 2.0 - BAR_M / 2.0);
            for band in 0..bands as u16 {
                let at_m = (f32::from(band) + 0.5) / bands - 0.5;
                let center_m = middle_m + along * at_m * length_m;
                let colour = if band % 2 == 0 { first } else { second };
                parts.push(Part { center_m, half_m, colour });
            }
        }
    }
    for y in [-1.0, 1.0] {
        for z in [-1.0, 1.0] {
            let out_m =
                (Vec3::new(0.0, width_m, height_m) + BAR_M * Vec3::new(0.0, 1.0, 1.0)) / 2.0;
            let center_m = out_m * Vec3::new(0.0, y, z);
            parts.push(Part { center_m, half_m: Vec3::splat(BAR_M / 2.0), colour: second });
        }
    }
    parts
}

/// Returns both colours of the stripes. [as displayed, 0 to 1]
fn colours(name: &str) -> Option<([f32; 3], [f32; 3])> {
    Some(match name {
        "orange" => ([0.93, 0.42, 0.08], [0.94, 0.93, 0.90]),
        "blue" => ([0.12, 0.36, 0.80], [0.94, 0.93, 0.90]),
        "green" => ([0.13, 0.58, 0.31], [0.94, 0.93, 0.90]),
        "white" => ([0.94, 0.93, 0.90], [0.20, 0.22, 0.26]),
        _ => return None,
    })
}

/// Width of a gate's bar: 3 of 160 pixels at 3 m. [m]
const BAR_M: f32 = 0.06;
/// Length of a stripe. [m]
const BAND_M: f32 = 0.2;
/// Patch size of plain faces: edges are as sharp as half of a bar. [m]
const PATCH_M: f32 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_model_has_the_size_of_its_name() {
        let reach = |file: &str| {
            let splats = model(file).unwrap_or_else(|| panic!("{file}"));
            let low = splats.means_m.iter().fold(Vec3::MAX, |low, p| low.min(*p));
            let high = splats.means_m.iter().fold(Vec3::MIN, |high, p| high.max(*p));
            (low, high, splats.len())
        };
        let (low, high, count) = reach("models/gate-120x100-blue.ply");
        assert!((high - Vec3::new(0.03, 0.66, 0.56)).abs().max_element() < 0.01, "{high}");
        assert!((low + high).abs().max_element() < 1e-5);
        assert!((1000..8000).contains(&count), "{count}");
        let (low, high, _) = reach("models/box-40x50x180.ply");
        assert!((low - Vec3::new(-0.2, -0.25, 0.0)).abs().max_element() < 0.01, "{low}");
        assert!((high - Vec3::new(0.2, 0.25, 1.8)).abs().max_element() < 0.01, "{high}");
        assert!(model("models/quadrotor.ply").is_some());
        for wrong in [
            "gate-120x100.ply",
            "models/gate-120.ply",
            "models/gate-120x100-red.ply",
            "models/gate-4x100.ply",
            "models/gate-120x1001.ply",
            "models/box-40x50x180",
            "models/gate-120x100-blue-2.ply",
            "models/../gate-120x100.ply",
            "models/.ply",
        ] {
            assert!(model(wrong).is_none(), "{wrong}");
        }
    }

    proptest! {
        #[test]
        fn any_name_gives_a_bounded_model_or_none(name in "(models/)?(gate|box|quadrotor)?-?[0-9x-]{0,12}(.ply)?") {
            if let Some(splats) = model(&name) {
                prop_assert!((1..400_000).contains(&splats.len()), "{name}: {}", splats.len());
            }
        }
    }
}
