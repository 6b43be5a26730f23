//! Benchmark of the latency from an image's last byte to the plugin's memory: [`crate::images`] on one thread, with
//! synthetic images.
//!
//! ```text
//! picture -> bitstream -> mailbox -> ImagePublisher -> shared memory -> the plugin's end
//!            (made once)  |--------------- timed, image by image ----------------|
//! ```

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow, ensure};
use serde::Serialize;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_protocol::messages::CameraInfo;
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView, peek, slice_len};
use vizflyt_sdk::ipc::{PluginEnd, RuntimeEnd};
use vizflyt_sdk::{Observation, ObservationWriter};

use crate::images::ImagePublisher;
use crate::stream::{Arrival, Mailbox, Whole};

/// Latency of images from their last byte to the plugin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DecodeFigures {
    /// Width of the images. [px]
    pub width_px: u32,
    /// Height of the images. [px]
    pub height_px: u32,
    /// Number of timed images.
    pub images: usize,
    /// Size of one image's bitstream. [bytes]
    pub bytes: usize,
    /// Median. [ms]
    pub ms_p50: f64,
    /// 99th percentile. [ms]
    pub ms_p99: f64,
    /// Maximum. [ms]
    pub ms_max: f64,
}

/// Decodes `count` RGB-D images of a size for a plugin, with the server's full quality.
///
/// # Errors
/// If size or count is 0, if shared memory is unavailable, or if an image does not arrive or has wrong depth.
pub fn decode([width_px, height_px]: [u32; 2], count: usize) -> Result<DecodeFigures> {
    ensure!(count > 0, "the number of images is 0; give 1 or more");
    let intrinsics = Intrinsics::from_horizontal_fov(width_px, height_px, 1.5);
    let (rgb, depth_mm) = picture(width_px, height_px);
    let view = RgbdView { width: width_px, height: height_px, rgb: &rgb, depth_mm: &depth_mm };
    let mut bitstream = Vec::new();
    Encoder::new(EncodeOptions::default()).encode(&view, &mut bitstream)?;
    let pieces = pieces(&bitstream)?;

    let cameras = vec![CameraInfo::forward("front", intrinsics)];
    let names = vec![cameras[0].name.clone()];
    let ipc = Arc::new(RuntimeEnd::new(ObservationWriter::len_for(&cameras)));
    let plugin = PluginEnd::attach(ipc.connect()?)?;
    let mut publisher = ImagePublisher::new(ipc, cameras, Arc::default());
    let mailbox = Mailbox::default();
    let mut ms = Vec::with_capacity(count);
    // The first images are not timed: caches are cold, and memory is new.
    for seq in 1..=(WARM_UP + count) as u64 {
        let identity = (Pose::IDENTITY, Pose::IDENTITY);
        let header =
            ImageHeader::new(seq, 0, ServerTime::ZERO, &intrinsics, &identity.0, &identity.1);
        let stamp = HostTime::from_ns(seq);
        let arrival = Arrival { session: 1, header, pose: stamp, first: stamp };
        let ticket =
            mailbox.open(&arrival).ok_or_else(|| anyhow!("image {seq} was not accepted"))?;
        for piece in &pieces {
            mailbox.push(ticket, &mut piece.clone());
        }
        let trailer = ImageTrailer::new(0, ServerTime::ZERO, ServerTime::ZERO);
        mailbox.end(ticket, Some(Whole { trailer, received: stamp }));
        let start = Instant::now();
        while publisher.step(&mailbox, Duration::ZERO, &mut |_| ())? {}
        let sample = plugin.observation()?.ok_or_else(|| anyhow!("image {seq} did not arrive"))?;
        if seq > WARM_UP as u64 {
            ms.push(start.elapsed().as_secs_f64() * 1e3);
        }
        let observation = Observation::from_bytes(sample.bytes(), &names)?;
        let image = observation
            .cameras()
            .next()
            .ok_or_else(|| anyhow!("observation {seq} has no image"))?;
        let (x, y) = (width_px / 2, height_px / 2);
        let sent_mm = depth_mm[(y * width_px + x) as usize];
        let came_m = image.depth_m(x, y).unwrap_or(f32::NAN);
        ensure!(
            (came_m * 1e3 - f32::from(sent_mm)).abs() < 1.0,
            "{sent_mm} mm arrived as {came_m} m"
        );
    }
    ms.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| ms[(share * (count - 1) as f64).round() as usize];
    Ok(DecodeFigures {
        width_px,
        height_px,
        images: count,
        bytes: bitstream.len(),
        ms_p50: at(0.5),
        ms_p99: at(0.99),
        ms_max: at(1.0),
    })
}

/// Splits a bitstream as on arrival: its head, then slice by slice.
fn pieces(bitstream: &[u8]) -> Result<Vec<Vec<u8>>> {
    let (head, mut rest) = bitstream.split_at(peek(bitstream)?.header_len);
    let mut pieces = vec![head.to_vec()];
    while let Some(len) = slice_len(rest) {
        let (slice, after) = rest.split_at(rest.len().min(len as usize));
        pieces.push(slice.to_vec());
        rest = after;
    }
    Ok(pieces)
}

/// Returns colour and depth [mm] that are about as hard to encode as a captured scene: texture of all scales, and depth
/// with edges.
fn picture(width_px: u32, height_px: u32) -> (Vec<u8>, Vec<u16>) {
    let (mut rgb, mut depth_mm) = (Vec::new(), Vec::new());
    for y in 0..height_px {
        for x in 0..width_px {
            let (u, v) = (x as f32 / width_px as f32, y as f32 / width_px as f32);
            let wave = |f: f32| (u * f).sin() * (v * f * 1.3 + 1.0).cos();
            let texture = 0.5 + 0.2 * wave(20.0) + 0.12 * wave(90.0) + 0.06 * wave(400.0);
            rgb.extend([texture, 0.8 * texture + 0.1, 1.0 - texture].map(|c| (c * 255.0) as u8));
            let near = wave(15.0) > 0.3;
            depth_mm.push(if near { 1500.0 + 200.0 * u } else { 3000.0 + 2000.0 * v } as u16);
        }
    }
    (rgb, depth_mm)
}

const WARM_UP: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_images_of_any_size() {
        for size in [[640, 480], [33, 17]] {
            let figures = decode(size, 3).unwrap();
            assert_eq!(([figures.width_px, figures.height_px], figures.images), (size, 3));
            assert!(0.0 < figures.ms_p50 && figures.ms_p50 <= figures.ms_max, "{figures:?}");
            assert!(figures.bytes > 100);
        }
        assert_eq!(
            decode([32, 24], 0).unwrap_err().to_string(),
            "the number of images is 0; give 1 or more"
        );
        assert!(decode([0, 24], 1).is_err());
    }
}
