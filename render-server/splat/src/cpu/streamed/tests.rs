use std::io::Cursor;
use std::sync::OnceLock;

use flate2::Crc;
use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Intrinsics, Pose};

use super::file::{AddError, Packer};
use super::*;
use crate::cpu::scene::GROUP;
use crate::{
    Camera, CpuRenderer, Detail, Rasterizer, RenderError, RgbdImage, RigidObject, Scene, Splats,
};

const ERROR_PX: f32 = 1.0;

/// Returns a lawn of 8 m by 8 m that starts at `x_m`; 40,000 splats, every hundredth of them 20 cm large.
fn lawn(x_m: f32, sh_degree: u8) -> Splats {
    let mut splats = Splats { sh_degree, ..Splats::default() };
    for i in 0..40_000u32 {
        let spread = |k: f64| (f64::from(i) * k).fract() as f32;
        let at = Vec3::new(spread(0.618_034), spread(0.732_051), 0.05 * spread(0.414_214));
        splats.means_m.push(at * 8.0 + Vec3::X * x_m);
        let size_m = if i % 100 == 0 { 0.2 } else { 0.01 + 0.02 * spread(0.236_068) };
        splats.scales_m.push(Vec3::new(size_m, 0.5 * size_m, 0.2 * size_m));
        splats.rotations.push(Quat::from_rotation_y(spread(0.302_776)));
        splats.opacities.push(0.2 + 0.7 * spread(0.135_335));
        splats
            .sh
            .extend((0..splats.sh_coefficients() * 3).map(|k| spread(0.1 + k as f64 * 0.07) - 0.3));
    }
    splats
}

/// Returns three lawns in a row; the middle one without harmonics.
fn lawns() -> [Splats; 3] {
    [lawn(0.0, 1), lawn(8.0, 0), lawn(16.0, 1)]
}

fn packed(parts: &[Splats]) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut packer = Packer::new(&mut bytes, ERROR_PX).unwrap();
    for part in parts {
        packer.add(part).unwrap();
    }
    let summary = packer.finish().unwrap();
    assert_eq!(summary.parts, parts.len());
    bytes.into_inner()
}

/// Returns the packed file of the lawns.
fn file() -> &'static [u8] {
    static FILE: OnceLock<Vec<u8>> = OnceLock::new();
    FILE.get_or_init(|| packed(&lawns()))
}

fn open(bytes: impl Into<Vec<u8>>) -> Result<PackedScene, PackedError> {
    PackedScene::from_source(Box::new(Cursor::new(bytes.into())))
}

fn streamed(blocks: usize, loading: Loading) -> CpuRenderer {
    let scene = open(file()).unwrap();
    let bytes = blocks * block_bytes(scene.coefficients);
    CpuRenderer::streamed(scene, &[], bytes, loading).unwrap()
}

/// Returns a camera 1.5 m above the lawns at `x_m`, looking along them and down by some degrees.
fn camera(x_m: f64, yaw_rad: f64) -> Camera {
    let ahead = DQuat::from_mat3(&glam::DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X));
    let turn = DQuat::from_rotation_z(yaw_rad) * DQuat::from_rotation_y(0.3) * ahead;
    let k = Intrinsics::from_horizontal_fov(160, 120, 1.2);
    Camera::new(k, Pose::new(DVec3::new(x_m, 4.0, 1.5), turn), 0.05)
}

fn render(
    renderer: &mut CpuRenderer,
    placements: usize,
    camera: Camera,
) -> Result<RgbdImage, RenderError> {
    let mut images = [RgbdImage::default()];
    renderer.render(&vec![Some(Pose::IDENTITY); placements], &[camera], &mut images)?;
    let [image] = images;
    Ok(image)
}

/// Renderer of the parts in memory: one is static, two are objects that do not move.
fn in_memory() -> CpuRenderer {
    let [still, rest @ ..] = lawns();
    let objects = rest.map(|mut splats| {
        // Converted to one degree, as in a pool.
        if splats.sh_degree == 0 {
            splats.sh = splats.sh.chunks(3).flat_map(|sh| [sh, &[0.0; 9]].concat()).collect();
            splats.sh_degree = 1;
        }
        RigidObject { id: 0, splats }
    });
    let scene = Scene { splats: &still, objects: &objects };
    CpuRenderer::with_detail(scene, Detail::Adaptive { max_error_px: ERROR_PX })
}

fn flight() -> impl Iterator<Item = Camera> {
    (0..12).map(|i| camera(f64::from(i) * 2.0 - 3.0, 0.4 * f64::from(i)))
}

/// Returns the maximum number of blocks that an image of the flight needs.
fn enough() -> usize {
    let mut renderer = streamed(10_000, Loading::Whole);
    let needed = flight().map(|camera| {
        render(&mut renderer, 0, camera).unwrap();
        renderer.streaming().unwrap().needed
    });
    needed.max().unwrap()
}

#[test]
fn waiting_image_equals_that_of_the_scene_in_memory() {
    let mut expected = in_memory();
    let enough = enough();
    assert!(enough < open(file()).unwrap().blocks.len() * 3 / 4, "slots are given to others");
    for blocks in [10_000, enough] {
        let mut renderer = streamed(blocks, Loading::Whole);
        for camera in flight() {
            let image = render(&mut renderer, 0, camera).unwrap();
            assert!(image == render(&mut expected, 2, camera).unwrap());
            assert_eq!(renderer.streaming().unwrap().stand_ins, 0);
            assert_eq!(renderer.workload().visible, expected.workload().visible);
        }
    }
}

#[test]
fn live_image_converges_to_the_complete_one() {
    let mut expected = in_memory();
    let mut renderer = streamed(enough() * 8 / 7 + 2, Loading::Live);
    for (i, camera) in flight().step_by(5).enumerate() {
        let whole = render(&mut expected, 2, camera).unwrap();
        let mut image = render(&mut renderer, 0, camera).unwrap();
        if i == 0 {
            let sum = |image: &RgbdImage| image.alpha.iter().sum::<f32>();
            let share = sum(&image) / sum(&whole);
            assert!((0.3..1.5).contains(&share), "{share} is covered by stand-ins");
            assert!(renderer.streaming().unwrap().stand_ins > 0 && image != whole);
        }
        for _ in 0..2000 {
            if image == whole {
                break;
            }
            std::thread::sleep(std::time::Duration::from_millis(1));
            image = render(&mut renderer, 0, camera).unwrap();
        }
        assert!(image == whole, "{:?}", renderer.streaming());
        assert_eq!(renderer.streaming().unwrap().stand_ins, 0);
    }
}

#[test]
fn renders_coarser_or_fails_if_memory_is_too_small() {
    let camera = camera(-1.0, 0.0);
    let mut whole = streamed(60, Loading::Whole);
    let refused = render(&mut whole, 0, camera).unwrap_err().to_string();
    assert!(refused.contains("more than the 2 MiB of memory"), "{refused}");

    let mut live = streamed(60, Loading::Live);
    for _ in 0..300 {
        render(&mut live, 0, camera).unwrap();
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    let Streaming { stand_ins, needed, most, max_error_px } = live.streaming().unwrap();
    assert!(needed <= most && most == 60, "{needed} of {most}");
    assert!(stand_ins == 0 && max_error_px > ERROR_PX, "{stand_ins}, {max_error_px} px");

    let scene = open(file()).unwrap();
    let refused = CpuRenderer::streamed(scene, &[], 40_000, Loading::Live).unwrap_err().to_string();
    assert!(refused.contains("too few for this scene"), "{refused}");
}

#[test]
fn packed_file_contains_the_packed_parts() {
    let scene = open(file()).unwrap();
    assert_eq!((scene.len(), scene.parts(), scene.max_error_px()), (120_000, 3, ERROR_PX));
    let empty = Splats { sh: Vec::new(), ..Splats::default() };
    assert!(Packer::new(Cursor::new(Vec::new()), 1.0).unwrap().finish().is_err());
    let mut packer = Packer::new(Cursor::new(Vec::new()), 1.0).unwrap();
    packer.add(&empty).unwrap();
    packer.add(&lawn(0.0, 0)).unwrap();
    let mip = Splats { antialiased: true, ..lawn(0.0, 0) };
    assert!(matches!(packer.add(&mip), Err(AddError::Mixed)));
    assert_eq!(packer.finish().unwrap().parts, 1);
}

#[test]
fn reports_a_damaged_block_when_it_is_needed() {
    let mut bytes = file().to_vec();
    // Far from the top blocks, which are read first.
    bytes[48 + 5 * block_bytes(4) + 77] ^= 1;
    let mut renderer =
        CpuRenderer::streamed(open(bytes).unwrap(), &[], 1 << 30, Loading::Whole).unwrap();
    let camera = camera(4.0, std::f64::consts::PI);
    let told = (0..2).map(|_| render(&mut renderer, 0, camera).unwrap_err().to_string());
    for told in told {
        assert_eq!(told, "packed scene, block 5: the checksum differs; the file is damaged");
    }
}

/// Recomputes the checksums of a modified file: of one block and of the tables.
fn seal(bytes: &mut [u8], block: usize) {
    let sum = |pieces: &[&[u8]]| {
        let mut crc = Crc::new();
        for piece in pieces {
            crc.update(piece);
        }
        crc.sum().to_le_bytes()
    };
    let tables = bytes.len() - open(file()).unwrap().blocks.len() * 36 - 24;
    let check = sum(&[&bytes[48..][block * block_bytes(4)..][..block_bytes(4)]]);
    bytes[tables + 24 + 36 * block + 32..][..4].copy_from_slice(&check);
    let check = sum(&[&bytes[..40], &bytes[tables..]]);
    bytes[40..44].copy_from_slice(&check);
}

#[test]
fn reads_original_splats_within_a_box() {
    let (min_m, max_m) = (Vec3::new(6.0, 2.0, -1.0), Vec3::new(9.0, 5.0, 1.0));
    let mut scene = open(file()).unwrap();
    let near = scene.splats_within(min_m, max_m, 40_000).unwrap();
    let mut found = 0;
    for splats in lawns() {
        for i in 0..splats.len() {
            let at_m = splats.means_m[i];
            if (at_m.cmplt(min_m) | at_m.cmpgt(max_m)).any() {
                continue;
            }
            found += 1;
            // Two splats may be at the same position.
            let same = near.means_m.iter().enumerate().filter(|(_, mean_m)| **mean_m == at_m);
            let is_same = |k: usize| {
                let wide = |rotation: Quat, scale_m: Vec3| {
                    let axes = glam::Mat3::from_quat(rotation) * glam::Mat3::from_diagonal(scale_m);
                    axes * axes.transpose()
                };
                let expected = wide(splats.rotations[i], splats.scales_m[i]);
                let covariance = wide(near.rotations[k], near.scales_m[k]);
                let constant = i * splats.sh_coefficients() * 3;
                covariance.abs_diff_eq(expected, 1e-6)
                    && (near.opacities[k] - splats.opacities[i]).abs() < 1e-5
                    && (0..3).all(|c| (near.sh[k * 3 + c] - splats.sh[constant + c]).abs() < 1e-3)
            };
            assert!(same.map(|(k, _)| k).any(is_same), "splat {i} at {at_m}");
        }
    }
    assert_eq!((near.len(), near.sh_degree), (found, 0));
    assert!(found > 1000, "{found}");
    let crowded = scene.splats_within(min_m, max_m, found - 1).unwrap_err().to_string();
    assert!(
        crowded.starts_with(&format!("more than {} splats lie between", found - 1)),
        "{crowded}"
    );
}

#[test]
fn splat_without_extent_keeps_a_rotation() {
    let splats = Splats {
        means_m: vec![Vec3::ZERO; 3],
        scales_m: vec![Vec3::ZERO, Vec3::new(0.0, 0.1, 0.0), Vec3::new(0.1, 0.0, 0.2)],
        rotations: vec![Quat::from_rotation_y(0.3); 3],
        opacities: vec![0.5; 3],
        sh: vec![0.1; 9],
        ..Splats::default()
    };
    let mut scene = open(packed(&[splats])).unwrap();
    let near = scene.splats_within(Vec3::NEG_ONE, Vec3::ONE, 3).unwrap();
    assert_eq!(near.len(), 3);
    for (rotation, scale_m) in near.rotations.iter().zip(&near.scales_m) {
        assert!(rotation.is_normalized());
        let longest = scale_m.max_position();
        if scale_m.max_element() > 0.0 {
            let was = Quat::from_rotation_y(0.3) * Vec3::AXES[longest];
            assert!((*rotation * Vec3::AXES[longest]).dot(was).abs() > 0.9999);
        }
    }
}

#[test]
fn objects_move_in_a_streamed_scene_as_in_memory() {
    let [still, ball, _] = lawns();
    let moving = [RigidObject { id: 7, splats: ball }];
    let scene = open(packed(std::slice::from_ref(&still))).unwrap();
    let mut streamed = CpuRenderer::streamed(scene, &moving, 1 << 26, Loading::Whole).unwrap();
    let whole = Scene { splats: &still, objects: &moving };
    let detail = Detail::Adaptive { max_error_px: ERROR_PX };
    let mut in_memory = CpuRenderer::with_detail(whole, detail);
    let image = render(&mut streamed, 1, camera(-2.0, 0.0)).unwrap();
    assert_eq!(image, render(&mut in_memory, 1, camera(-2.0, 0.0)).unwrap());
    assert!(image.ids.contains(&7));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn rejects_a_truncated_or_damaged_file(cut in 0usize..100_000, at in 0usize..100_000, bit in 0..8) {
        let whole = file();
        let cut = whole.len() * cut / 100_000;
        prop_assert!(open(&whole[..cut]).is_err());
        // Damages tables and header; blocks are checked when they are read.
        let tables = open(whole).unwrap().blocks.len() * 36 + 24 + 44;
        let at = at % tables;
        let at = if at < 44 { at } else { whole.len() - 1 - (at - 44) };
        let mut bytes = whole.to_vec();
        bytes[at] ^= 1u8 << bit;
        prop_assert!(open(bytes).is_err());
    }

    #[test]
    fn reads_or_rejects_arbitrary_bytes(mut bytes in prop::collection::vec(any::<u8>(), 0..400), is_sealed: bool) {
        if is_sealed && bytes.len() > 48 {
            bytes[..8].copy_from_slice(MAGIC);
            bytes[8..12].copy_from_slice(&1u32.to_le_bytes());
            bytes[12..40].iter_mut().for_each(|byte| *byte %= 3);
        }
        let _ = open(bytes);
    }

    #[test]
    fn renders_or_rejects_untrusted_numbers(
        numbers in prop::collection::vec((0usize..4000, any::<u32>()), 1..40),
        rows in prop::collection::vec((0usize..8, any::<u32>()), 0..4),
        block in 0usize..100,
    ) {
        let mut bytes = file().to_vec();
        for (at, number) in numbers {
            bytes[48 + block * block_bytes(4) + at * 4..][..4].copy_from_slice(&number.to_le_bytes());
        }
        let table = bytes.len() - open(file()).unwrap().blocks.len() * 36;
        for (at, number) in rows {
            bytes[table + block * 36 + at * 4..][..4].copy_from_slice(&number.to_le_bytes());
        }
        seal(&mut bytes, block);
        let Ok(mut scene) = open(bytes) else { return Ok(()) };
        if let Ok(near) = scene.splats_within(Vec3::ZERO, Vec3::splat(8.0), 1 << 20) {
            let are_splats = near.rotations.iter().all(|turn| turn.is_normalized())
                && near.scales_m.iter().all(|scale| scale.is_finite());
            prop_assert!(are_splats);
        }
        let Ok(mut renderer) = CpuRenderer::streamed(scene, &[], 1 << 26, Loading::Whole) else { return Ok(()) };
        for yaw_rad in [0.0, 3.0] {
            match render(&mut renderer, 0, camera(4.0, yaw_rad)) {
                Ok(image) => prop_assert_eq!(image.alpha.len(), 160 * 120),
                Err(error) => prop_assert!(matches!(error, RenderError::Scene(_))),
            }
        }
    }
}

#[test]
fn file_layout_matches_memory_layout() {
    // Assumptions of `seal` and of the format's description.
    assert_eq!((GEOMETRY, GROUP, block_bytes(4)), (3328, 16, 13_312 + 6_144));
}
