//! A V4L2 camera of Linux, with exposure times of its images.
//!
//! `/dev/video0`, or `/dev/video0:1280x720@60`. Supported formats are grey, NV12, YUYV and Motion JPEG; the first in
//! this order that the camera offers is used. Drivers stamp an image at the beginning of its exposure or when its last
//! byte was read, and report which of these they use. The stamp is moved to the middle of the middle row's exposure.

mod ffi;

use std::fs::{File, OpenOptions};
use std::time::Duration;

use super::decode::jpeg;
use super::{CaptureError, Exposure, ImageSource};
use crate::image::Gray;
use ffi::{Buffers, Fourcc, StampKind};

/// A streaming V4L2 camera.
#[derive(Debug)]
pub struct Camera {
    name: String,
    buffers: Buffers,
    layout: Pixels,
    /// Interval of images. [ns]
    period_ns: u64,
    /// Exposure time; 0 if the camera does not report it. [ns]
    exposure_ns: u64,
}

/// Layout of pixels in a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Pixels {
    width: u32,
    height: u32,
    /// Offset between rows. [bytes]
    stride: usize,
    kind: Fourcc,
}

impl Camera {
    /// Opens a camera and starts its stream.
    ///
    /// # Errors
    /// [`CaptureError`] if it does not exist, is not a camera, is in use, or has no supported format.
    pub fn open(source: &str) -> Result<Self, CaptureError> {
        let (path, request) = parse(source).map_err(|why| CaptureError::unfit(source, why))?;
        let io = |error| CaptureError::io(path, error);
        let file: File = OpenOptions::new().read(true).write(true).open(path).map_err(io)?;
        if !ffi::streams(&file).map_err(|_| {
            CaptureError::unfit(path, "not a V4L2 device; `v4l2-ctl --list-devices` lists them")
        })? {
            let why =
                "this device does not stream images; cameras often have two devices, try the other";
            return Err(CaptureError::unfit(path, why));
        }
        let mut layout = None;
        for kind in Fourcc::ALL {
            let found =
                ffi::set_format(&file, kind, [request.width, request.height]).map_err(io)?;
            if found.kind == kind {
                layout = Some(found);
                break;
            }
        }
        let Some(layout) = layout else {
            let why = "the camera does not offer GREY, YUYV, NV12 or MJPG; use a command, for example \
                       `| gst-launch-1.0 ...`";
            return Err(CaptureError::unfit(path, why));
        };
        if (layout.width, layout.height) != (request.width, request.height) {
            let why = format!(
                "the camera uses {}x{} instead of {}x{}; a calibration is valid for one size only",
                layout.width, layout.height, request.width, request.height
            );
            return Err(CaptureError::unfit(path, why));
        }
        let period_ns = ffi::set_rate(&file, request.rate_hz).unwrap_or(1_000_000_000 / 30);
        let exposure_ns = ffi::exposure_ns(&file).unwrap_or(0);
        let buffers = Buffers::start(file).map_err(io)?;
        Ok(Self { name: path.to_owned(), buffers, layout, period_ns, exposure_ns })
    }
}

impl ImageSource for Camera {
    fn next(&mut self) -> Result<Option<Exposure>, CaptureError> {
        let (layout, period_ns, exposure_ns) = (self.layout, self.period_ns, self.exposure_ns);
        loop {
            let taken = self.buffers.take(WAIT, |bytes, stamp_ns, stamped| {
                let stamp_ns = middle_ns(stamp_ns, stamped, period_ns, exposure_ns);
                // A damaged image of a live camera is dropped; the next one follows soon.
                grey(bytes, layout).map(|image| Exposure { stamp_ns, image })
            });
            match taken {
                Ok(Some(Some(exposure))) => return Ok(Some(exposure)),
                Ok(Some(None)) => {}
                Ok(None) => {
                    let why = format!("no image for {} s; is it unplugged?", WAIT.as_secs());
                    return Err(CaptureError::unfit(&self.name, why));
                }
                Err(error) => return Err(CaptureError::io(&self.name, error)),
            }
        }
    }

    fn is_live(&self) -> bool {
        true
    }
}

/// Requested size and rate.
#[derive(Clone, Copy, Debug, PartialEq)]
struct FormatRequest {
    width: u32,
    height: u32,
    rate_hz: u32,
}

/// Parses `/dev/video0:1280x720@60`.
fn parse(source: &str) -> Result<(&str, FormatRequest), String> {
    let mut request = FormatRequest { width: 1280, height: 720, rate_hz: 60 };
    let Some((path, mode)) = source.split_once(':') else { return Ok((source, request)) };
    let wrong = || format!("mode {mode:?} is invalid; write it as 1280x720 or 1280x720@60");
    let (size, rate) = mode.split_once('@').unwrap_or((mode, "60"));
    let (width, height) = size.split_once('x').ok_or_else(wrong)?;
    request.width = width.parse().map_err(|_| wrong())?;
    request.height = height.parse().map_err(|_| wrong())?;
    request.rate_hz = rate.parse().map_err(|_| wrong())?;
    super::decode::check(request.width, request.height)?;
    if !(1..=1000).contains(&request.rate_hz) {
        return Err(wrong());
    }
    Ok((path, request))
}

/// Returns the middle of the middle row's exposure.
fn middle_ns(stamp_ns: u64, stamped: StampKind, period_ns: u64, exposure_ns: u64) -> u64 {
    // Rows are read one after the other, over nearly the whole period: the middle row is half a period later than the
    // first.
    let half_readout_ns = period_ns / 2;
    match stamped {
        StampKind::ExposureBegan => stamp_ns + exposure_ns / 2 + half_readout_ns,
        StampKind::LastByte => stamp_ns.saturating_sub(half_readout_ns + exposure_ns / 2),
    }
}

/// Returns the brightness in a buffer; `None` if bytes are missing or damaged.
fn grey(bytes: &[u8], layout: Pixels) -> Option<Gray> {
    let Pixels { width, height, stride, kind } = layout;
    if kind == Fourcc::MotionJpeg {
        return jpeg(bytes).ok().filter(|i| (i.width_px(), i.height_px()) == (width, height));
    }
    let mut pixels = Vec::with_capacity(width as usize * height as usize);
    for row in 0..height as usize {
        let row = bytes.get(row * stride..)?;
        match kind {
            // The first plane of NV12 is brightness.
            Fourcc::Grey | Fourcc::Nv12 => pixels.extend_from_slice(row.get(..width as usize)?),
            // Every second byte is brightness.
            _ => pixels.extend(row.get(..2 * width as usize)?.iter().step_by(2)),
        }
    }
    Gray::new(width, height, pixels)
}

/// Time without images after which a camera counts as disconnected.
const WAIT: Duration = Duration::from_secs(3);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_size_and_rate_of_a_mode() {
        let request = FormatRequest { width: 640, height: 480, rate_hz: 120 };
        assert_eq!(parse("/dev/video2:640x480@120"), Ok(("/dev/video2", request)));
        assert_eq!(
            parse("/dev/video2").unwrap().1,
            FormatRequest { width: 1280, height: 720, rate_hz: 60 }
        );
        for wrong in
            ["/dev/video0:640", "/dev/video0:0x480", "/dev/video0:640x480@0", "/dev/video0:axb"]
        {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn reads_brightness_of_every_pixel_format() {
        let yuyv = [1, 0, 2, 0, 9, 9, 3, 0, 4, 0, 9, 9];
        let layout = Pixels { width: 2, height: 2, stride: 6, kind: Fourcc::Yuyv };
        assert_eq!(grey(&yuyv, layout).unwrap().pixels(), [1, 2, 3, 4]);
        let nv12 = [1, 2, 9, 3, 4, 9, 128, 128];
        let layout = Pixels { stride: 3, kind: Fourcc::Nv12, ..layout };
        assert_eq!(grey(&nv12, layout).unwrap().pixels(), [1, 2, 3, 4]);
        assert_eq!(grey(&nv12[..4], layout), None);
        assert_eq!(grey(b"\xff\xd8no", Pixels { kind: Fourcc::MotionJpeg, ..layout }), None);
    }

    #[test]
    fn moves_stamps_to_the_middle_of_the_exposure() {
        let ms = 1_000_000;
        // Exposure 4 ms, interval 16 ms, and the first row's exposure begins at 100 ms: the middle row is exposed from
        // 108 to 112 ms, and the last byte is read at 120 ms.
        let began = middle_ns(100 * ms, StampKind::ExposureBegan, 16 * ms, 4 * ms);
        let ended = middle_ns(120 * ms, StampKind::LastByte, 16 * ms, 4 * ms);
        assert_eq!((began, ended), (110 * ms, 110 * ms));
    }
}
