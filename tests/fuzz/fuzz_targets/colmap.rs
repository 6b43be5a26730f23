//! Untrusted COLMAP files, text and binary: an error, or a model with finite values.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_twin::dataset::colmap::{Cameras, binary, text};
use vizflyt_twin::dataset::{SparseImage, SparsePoint};

fn cameras() -> Cameras {
    text::cameras("1 PINHOLE 640 480 400 400 320 240").expect("a pinhole is understood")
}

fn check_images(images: &[SparseImage], bytes: usize) {
    assert!(images.len() <= bytes);
    for image in images {
        assert!(
            image.world_from_cam.translation_m.is_finite() && image.intrinsics.validate().is_ok()
        );
        assert!(image.seen.iter().all(|seen| seen.pixel.is_finite()));
    }
}

fn check_points<'a>(points: impl Iterator<Item = &'a SparsePoint>) {
    assert!(points.into_iter().all(|point| point.position.is_finite()));
}

fuzz_target!(|bytes: &[u8]| {
    for read in [binary::cameras(bytes), text::cameras(&String::from_utf8_lossy(bytes))] {
        match read {
            Ok(cameras) => assert!(cameras.values().all(|camera| camera.validate().is_ok())),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
    for read in [
        binary::images(bytes, &cameras()),
        text::images(&String::from_utf8_lossy(bytes), &cameras()),
    ] {
        match read {
            Ok(images) => check_images(&images, bytes.len()),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
    for read in [binary::points(bytes), text::points(&String::from_utf8_lossy(bytes))] {
        match read {
            Ok(points) => check_points(points.values()),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
});
