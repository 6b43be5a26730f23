//! Ink on white sheets: detected at the layout's positions, and not drawn over objects in front of a sheet.

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::Intrinsics;

use super::*;
use crate::detect::{Detector, DetectorSettings};
use crate::family::TagFamily;
use crate::image::Gray;
use crate::layout::{LayoutFrame, Square, Tag};
use crate::synth::webcam;

/// A tag 1.5 m in front of a camera at the world's origin that looks along z; the tag is rotated, on a white wall in
/// its plane.
fn scene(k: &Intrinsics) -> (TagLayout, Vec<f32>, Vec<f32>) {
    // The face points back to the camera.
    let turn = DQuat::from_rotation_y(0.4) * DQuat::from_rotation_x(std::f64::consts::PI);
    let world_from_tag: Pose<World, Square> = Pose::new(DVec3::new(0.2, 0.1, 1.5), turn);
    let tag = Tag::new(TagFamily::Tag36h11, 7, 0.24, world_from_tag);
    let mut depth_m = Vec::new();
    for y in 0..k.height_px {
        for x in 0..k.width_px {
            let slope = k.slope(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).unwrap();
            let along = tag.normal().dot(tag.position_m) / tag.normal().dot(slope.extend(1.0));
            depth_m.push(along as f32);
        }
    }
    (TagLayout { frame: LayoutFrame::World, tags: vec![tag] }, vec![0.6; 3 * k.pixels()], depth_m)
}

fn grey(k: &Intrinsics, light: &[f32]) -> Gray {
    let pixels = light.chunks_exact(3).map(|light| (light[0] * 255.0 + 0.5) as u8).collect();
    Gray::new(k.width_px, k.height_px, pixels).unwrap()
}

#[test]
fn draws_ink_at_the_layouts_positions() {
    let k = webcam();
    let (layout, mut light, depth_m) = scene(&k);
    let sheets = Sheets { light: &mut light, depth_m: &depth_m, world_from_cam: Pose::IDENTITY };
    Renderer::new(k).ink(&layout, sheets, 0.4);
    let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
    let found = detector.search(&grey(&k, &light), &k, true);
    let [found] = &found[..] else { panic!("{found:?}") };
    assert_eq!(found.id, 7);
    for (corner_px, corner_m) in found.corners_px.iter().zip(layout.tags[0].corners_m()) {
        let off_px = (*corner_px - k.project(corner_m).unwrap()).length();
        assert!(off_px < 0.1, "{off_px} px");
    }
    // Black is darkened, and white is unchanged.
    let least = light.iter().copied().fold(1.0, f32::min);
    assert!((least - 0.6 * INK).abs() < 1e-6 && light[0] == 0.6, "{least}");
}

#[test]
fn does_not_draw_on_objects_or_pixels_without_depth() {
    let k = webcam();
    let (layout, white, sheet_m) = scene(&k);
    for depth_m in [0.8f32, 0.0, f32::NAN] {
        // An object in front of the sheet's upper half.
        let covered = |n: usize| n / k.width_px as usize <= 390;
        let depth_m: Vec<f32> = sheet_m
            .iter()
            .enumerate()
            .map(|(n, &sheet_m)| if covered(n) { depth_m } else { sheet_m })
            .collect();
        let mut light = white.clone();
        let sheets =
            Sheets { light: &mut light, depth_m: &depth_m, world_from_cam: Pose::IDENTITY };
        Renderer::new(k).ink(&layout, sheets, 0.4);
        let inked = |n: usize| light[3 * n] < 0.6;
        assert!((0..k.pixels()).any(inked), "the lower half is inked");
        assert!((0..k.pixels()).filter(|&n| covered(n)).all(|n| !inked(n)));
    }
}

#[test]
fn does_not_draw_on_the_back_of_a_board() {
    let k = webcam();
    let (mut layout, mut light, depth_m) = scene(&k);
    let white = light.clone();
    layout.tags[0].rotation_xyzw *= DQuat::from_rotation_y(std::f64::consts::PI);
    let sheets = Sheets { light: &mut light, depth_m: &depth_m, world_from_cam: Pose::IDENTITY };
    Renderer::new(k).ink(&layout, sheets, 0.4);
    assert_eq!(light, white);
}
