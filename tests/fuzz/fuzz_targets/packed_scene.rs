//! Untrusted packed scene: an error, or an image. The checksum of the tables is corrected, so that the tables are read;
//! the checksums of blocks are not.
#![no_main]
use std::io::Cursor;

use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{Camera, CpuRenderer, Loading, PackedScene, Rasterizer, RgbdImage};

/// Size of the header, and of the part that its checksum covers. [bytes]
const HEADER: usize = 48;
const CHECKED: usize = 40;

fuzz_target!(|bytes: &[u8]| {
    let mut bytes = bytes.to_vec();
    if bytes.len() >= HEADER {
        bytes[..8].copy_from_slice(b"VFPACKED");
        let number =
            |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four")) as usize;
        let tables = (number(12) * 8).saturating_add(number(16) * 36).min(bytes.len() - HEADER);
        let mut crc = flate2::Crc::new();
        crc.update(&bytes[..CHECKED]);
        crc.update(&bytes[bytes.len() - tables..]);
        bytes[CHECKED..CHECKED + 4].copy_from_slice(&crc.sum().to_le_bytes());
    }
    let len = bytes.len();
    let Ok(mut scene) = PackedScene::from_source(Box::new(Cursor::new(bytes))) else { return };
    assert!(scene.len() <= len, "{} splats in {len} bytes", scene.len());
    let all = glam::Vec3::INFINITY;
    if let Ok(near) = scene.splats_within(-all, all, len) {
        assert!(near.len() <= len, "{} splats in {len} bytes", near.len());
    }
    let Ok(mut renderer) = CpuRenderer::streamed(scene, &[], 1 << 24, Loading::Whole) else {
        return;
    };
    let camera = Camera::new(Intrinsics::from_horizontal_fov(48, 32, 1.2), Pose::IDENTITY, 0.05);
    // Damaged blocks give an error; the camera is valid.
    let _ = renderer.render(&[], &[camera], &mut [RgbdImage::default()]);
});
