//! Layers that are computed pixel by pixel: depth of surfaces, classes, ids of things.

use vizflyt_splat::RgbdImage;

/// Writes the depth of visible surfaces along the optical axis, row-major; 0: none. If expected and median depth belong
/// to the same surface, it uses the expected depth, which is smooth along a surface. Otherwise, it uses the median
/// depth, which never lies between two surfaces. [m, cam]
pub fn surface_depth(image: &RgbdImage, out: &mut Vec<f32>) {
    out.clear();
    let depths = image.depth_median_m.iter().zip(&image.depth_expected_m).zip(&image.alpha);
    out.extend(depths.map(|((&median_m, &expected_m), &alpha)| {
        let is_seen = alpha >= RgbdImage::MIN_DEPTH_ALPHA && median_m > 0.0;
        let is_one = (expected_m - median_m).abs() <= SAME_M + SAME * median_m;
        if is_seen { if is_one { expected_m } else { median_m } } else { 0.0 }
    }));
}

/// Converts depth [m] to integer millimetres; 0 for none or beyond 65.535 m.
pub fn depth_mm(depth_m: &[f32], out: &mut Vec<u16>) {
    out.clear();
    out.extend(depth_m.iter().map(|depth_m| {
        let mm = depth_m * 1000.0 + 0.5;
        if mm < 65536.0 { mm as u16 } else { 0 }
    }));
}

/// Writes the class of each pixel, from the class of its id in `of_id`; 0 for pixels without depth.
///
/// # Panics
/// An id has no class.
pub fn classes(depth_m: &[f32], ids: &[u16], of_id: &[u8], out: &mut Vec<u8>) {
    out.clear();
    let pixels = depth_m.iter().zip(ids);
    out.extend(pixels.map(|(&z_m, &id)| {
        let class = of_id[usize::from(id)];
        if z_m > 0.0 { class } else { 0 }
    }));
}

/// Writes the ids of pixels of things, according to `is_thing`; 0 for all others and for pixels without depth.
///
/// # Panics
/// An id is beyond the end of `is_thing`.
pub fn instances(depth_m: &[f32], ids: &[u16], is_thing: &[bool], out: &mut Vec<u16>) {
    out.clear();
    let pixels = depth_m.iter().zip(ids);
    out.extend(pixels.map(|(&z_m, &id)| {
        let is_thing = is_thing[usize::from(id)] && z_m > 0.0;
        if is_thing { id } else { 0 }
    }));
}

/// Maximum difference between expected and median depth on one surface: the sum of `SAME_M` [m] and `SAME`
/// times the depth.
const SAME_M: f32 = 0.02;
const SAME: f32 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_smooth_on_surfaces_and_sharp_at_edges() {
        let mut image = RgbdImage::default();
        image.resize(4, 1);
        image.alpha = vec![1.0, 1.0, 0.4, 1.0];
        image.depth_median_m = vec![2.0, 2.0, 2.0, f32::NAN];
        image.depth_expected_m = vec![2.03, 3.0, 2.0, 2.0];
        let mut depth_m = Vec::new();
        surface_depth(&image, &mut depth_m);
        assert_eq!(depth_m, [2.03, 2.0, 0.0, 0.0]);
        let mut mm = Vec::new();
        depth_mm(&[1.2344, 70.0, 0.0], &mut mm);
        assert_eq!(mm, [1234, 0, 0]);
        let mut labels = Vec::new();
        classes(&depth_m, &[0, 1, 1, 0], &[1, 9], &mut labels);
        assert_eq!(labels, [1, 9, 0, 0]);
    }
}
