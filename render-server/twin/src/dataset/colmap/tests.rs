//! Models in text and binary form, and invalid ones.

use glam::DVec3;
use proptest::prelude::*;
use vizflyt_protocol::geometry::Distortion;

use super::*;
use crate::dataset::{SparsePoint, SparseSighting};

const CAMERAS: &str = "# comment\n1 OPENCV 640 480 400 401 320 240 0.1 -0.05 0.001 0.002\n\n2 SIMPLE_PINHOLE 640 480 400 320 240\n";
const IMAGES: &str =
    "# comment\n3 0.5 0.5 0.5 0.5 1 2 3 1 a b.png\n10 20 7 30 40 -1\n4 1 0 0 0 0 0 0 2 c.jpg\n\n";
const SEEN: [SparseSighting; 1] =
    [SparseSighting { point: 7, pixel: glam::DVec2::new(10.0, 20.0) }];
const POINTS: &str = "7 1.5 2.5 3.5 10 20 30 0.4 3 0 4 1\n";

#[test]
fn reads_text() {
    let cameras = text::cameras(CAMERAS).unwrap();
    assert_eq!(cameras[&1].fy_px, 401.0);
    let bent = Distortion::BrownConrady { k1: 0.1, k2: -0.05, p1: 0.001, p2: 0.002, k3: 0.0 };
    assert_eq!(cameras[&1].distortion, bent);
    assert_eq!(cameras[&2].distortion, Distortion::None);
    let images = text::images(IMAGES, &cameras).unwrap();
    assert_eq!((images[0].name.as_str(), images[1].name.as_str()), ("a b.png", "c.jpg"));
    assert_eq!((images[0].seen.as_slice(), images[1].seen.len()), (&SEEN[..], 0));
    // The rotation (1, 1, 1, 1) / 2 takes x to y to z to x: COLMAP's is cam_from_world.
    let p_cam = images[0].world_from_cam.inverse().transform_point(DVec3::X);
    assert!((p_cam - DVec3::new(1.0, 3.0, 3.0)).length() < 1e-12);
    let points = text::points(POINTS).unwrap();
    assert_eq!((points[&7].rgb, points[&7].track), ([10, 20, 30], 2));
}

#[test]
fn text_error_names_the_fault() {
    let cameras = text::cameras(CAMERAS).unwrap();
    let check = |result: Result<(), ColmapError>, says: &str| {
        let error = result.unwrap_err().to_string();
        assert!(error.contains(says), "{error}");
    };
    check(text::cameras("1 FULL_OPENCV 6 4 1 1 1 1 0 0 0 0 0 0.1 0 0").map(drop), "FULL_OPENCV");
    check(text::cameras("1 BALLOON 6 4 1").map(drop), "BALLOON");
    check(
        text::cameras("1 PINHOLE 640 480 400 400 320").map(drop),
        "line 1: camera model PINHOLE has 3",
    );
    check(text::cameras("1 PINHOLE 640 480 -1 400 320 3").map(drop), "focal length");
    check(text::cameras("x PINHOLE").map(drop), "the camera's id is 'x'");
    check(text::images("3 1 0 0 0 1 2 3 9 a.png\n\n", &cameras).map(drop), "camera 9");
    check(text::images("3 0 0 0 0 1 2 3 1 a.png\n\n", &cameras).map(drop), "rotation");
    check(text::images("3 1 0 0 0 1 2 3 1 a.png\n1 2\n", &cameras).map(drop), "line 2");
    check(text::points("7 1 2 3 10 20 300 0.4").map(drop), "the colour is '300'");
}

/// Writes the binary files, as COLMAP's `src/colmap/scene/reconstruction_io.cc` does.
fn binary() -> [Vec<u8>; 3] {
    let mut cameras = 1u64.to_le_bytes().to_vec();
    cameras.extend(1i32.to_le_bytes());
    cameras.extend(1i32.to_le_bytes());
    cameras.extend(640u64.to_le_bytes());
    cameras.extend(480u64.to_le_bytes());
    for v in [400f64, 401.0, 320.0, 240.0] {
        cameras.extend(v.to_le_bytes());
    }
    let mut images = 1u64.to_le_bytes().to_vec();
    images.extend(3i32.to_le_bytes());
    for v in [0.5f64, 0.5, 0.5, 0.5, 1.0, 2.0, 3.0] {
        images.extend(v.to_le_bytes());
    }
    images.extend(1i32.to_le_bytes());
    images.extend(b"a.png\0");
    images.extend(2u64.to_le_bytes());
    for id in [7u64, u64::MAX] {
        images.extend(10f64.to_le_bytes());
        images.extend(20f64.to_le_bytes());
        images.extend(id.to_le_bytes());
    }
    let mut points = 1u64.to_le_bytes().to_vec();
    points.extend(7u64.to_le_bytes());
    for v in [1.5f64, 2.5, 3.5] {
        points.extend(v.to_le_bytes());
    }
    points.extend([10, 20, 30]);
    points.extend(0.4f64.to_le_bytes());
    points.extend(2u64.to_le_bytes());
    points.extend([0; 16]);
    [cameras, images, points]
}

#[test]
fn reads_binary_and_rejects_every_truncation() {
    let [camera_bytes, image_bytes, point_bytes] = binary();
    let cameras = binary::cameras(&camera_bytes).unwrap();
    let images = binary::images(&image_bytes, &cameras).unwrap();
    let points = binary::points(&point_bytes).unwrap();
    let text_points = text::points(POINTS).unwrap();
    assert_eq!((&points, &images[0].seen[..]), (&text_points, &SEEN[..]));
    let p_cam = images[0].world_from_cam.inverse().transform_point(DVec3::X);
    assert!((p_cam - DVec3::new(1.0, 3.0, 3.0)).length() < 1e-12);
    for len in 0..camera_bytes.len() {
        assert!(binary::cameras(&camera_bytes[..len]).is_err());
    }
    for len in 0..image_bytes.len() {
        assert!(binary::images(&image_bytes[..len], &cameras).is_err());
    }
    for len in 0..point_bytes.len() {
        assert!(binary::points(&point_bytes[..len]).is_err());
    }
    // A count that would need more memory than the file has bytes.
    let mut hostile = point_bytes.clone();
    hostile[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert!(binary::points(&hostile).unwrap_err().to_string().contains("do not fit"));
    let mut unknown = camera_bytes.clone();
    unknown[12] = 10;
    assert_eq!(
        binary::cameras(&unknown),
        Err(ColmapError::Damaged(
            "at byte 64: the file ends within a record; was it copied whole?".to_owned()
        ))
    );
    unknown[12] = 99;
    assert_eq!(binary::cameras(&unknown), Err(ColmapError::Lens("number 99".to_owned())));
}

proptest! {
    #[test]
    fn does_not_panic_on_random_bytes(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let cameras = Cameras::new();
        let _ = (binary::cameras(&bytes), binary::images(&bytes, &cameras), binary::points(&bytes));
        let text = String::from_utf8_lossy(&bytes);
        let _ = (text::cameras(&text), text::images(&text, &cameras), text::points(&text));
    }
}

#[test]
fn reads_back_a_written_model() {
    let cameras = text::cameras(CAMERAS).unwrap();
    let images = text::images(IMAGES, &cameras).unwrap();
    let points = HashMap::from([(
        7,
        SparsePoint { position: DVec3::new(1.5, -2.5, 1.0 / 3.0), rgb: [1, 2, 255], track: 1 },
    )]);
    let model = SparseModel { images, points };
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("sparse/0");
    write(&place, &model).unwrap();
    let back = read(&place).unwrap();
    assert_eq!(back.points, model.points);
    for (back, image) in back.images.iter().zip(&model.images) {
        assert_eq!(
            (&back.name, back.intrinsics, &back.seen),
            (&image.name, image.intrinsics, &image.seen)
        );
        let off = back.world_from_cam.translation_m - image.world_from_cam.translation_m;
        assert!(off.length() < 1e-12, "{off}");
        assert!(back.world_from_cam.rotation.angle_between(image.world_from_cam.rotation) < 1e-7);
    }
    assert_eq!(back.images.len(), 2);
    assert!(write(&folder.path().join("sparse/0/images.txt/x"), &model).is_err());
}
