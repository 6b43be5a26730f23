//! The V4L2 requests for a camera, on 64-bit machines (Linux kernel, `videodev2.h`; "Video for Linux API", chapters
//! 1.3, 3.2 and 7).

#![allow(unsafe_code, reason = "ioctl and mmap of Video4Linux")]

use std::fs::File;
use std::io;
use std::os::fd::{AsFd as _, AsRawFd as _};
use std::time::Duration;

use memmap2::{Mmap, MmapOptions};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use super::Pixels;

/// Supported pixel formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fourcc {
    /// One byte of brightness per pixel.
    Grey,
    /// Two pixels in four bytes: Y U Y V.
    Yuyv,
    /// A plane of brightness, then one of colours.
    Nv12,
    /// A JPEG per image.
    MotionJpeg,
}

impl Fourcc {
    /// All formats, the cheapest to decode first.
    pub(super) const ALL: [Self; 4] = [Self::Grey, Self::Nv12, Self::Yuyv, Self::MotionJpeg];

    fn code(self) -> u32 {
        u32::from_le_bytes(*match self {
            Self::Grey => b"GREY",
            Self::Yuyv => b"YUYV",
            Self::Nv12 => b"NV12",
            Self::MotionJpeg => b"MJPG",
        })
    }
}

/// Meaning of a driver's stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StampKind {
    /// Beginning of the first row's exposure.
    ExposureBegan,
    /// Time at which the last byte was read.
    LastByte,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct Capability {
    driver: [u8; 16],
    card: [u8; 32],
    bus_info: [u8; 32],
    version: u32,
    capabilities: u32,
    device_caps: u32,
    reserved: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Copy)]
struct PixFormat {
    width: u32,
    height: u32,
    pixelformat: u32,
    field: u32,
    bytesperline: u32,
    sizeimage: u32,
    rest: [u32; 44],
}

#[repr(C)]
#[derive(Clone, Copy)]
struct Format {
    kind: u32,
    // The kernel's union contains pointers and has their alignment.
    padding: u32,
    pix: PixFormat,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct StreamParm {
    kind: u32,
    capability: u32,
    capturemode: u32,
    numerator: u32,
    denominator: u32,
    rest: [u32; 46],
}

#[repr(C)]
#[derive(Clone, Copy)]
struct RequestBuffers {
    count: u32,
    kind: u32,
    memory: u32,
    capabilities: u32,
    flags: u32,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Buffer {
    index: u32,
    kind: u32,
    bytesused: u32,
    flags: u32,
    field: u32,
    padding: u32,
    seconds: i64,
    microseconds: i64,
    timecode: [u32; 4],
    sequence: u32,
    memory: u32,
    /// Part of the union: offset for mmap.
    offset: u64,
    length: u32,
    reserved: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Copy)]
struct Control {
    id: u32,
    value: i32,
}

const _: () = {
    assert!(size_of::<Capability>() == 104);
    assert!(size_of::<Format>() == 208);
    assert!(size_of::<StreamParm>() == 204);
    assert!(size_of::<RequestBuffers>() == 20);
    assert!(size_of::<Buffer>() == 88);
    assert!(size_of::<Control>() == 8);
};

nix::ioctl_read!(query_cap, b'V', 0, Capability);
nix::ioctl_readwrite!(s_fmt, b'V', 5, Format);
nix::ioctl_readwrite!(reqbufs, b'V', 8, RequestBuffers);
nix::ioctl_readwrite!(querybuf, b'V', 9, Buffer);
nix::ioctl_readwrite!(qbuf, b'V', 15, Buffer);
nix::ioctl_readwrite!(dqbuf, b'V', 17, Buffer);
nix::ioctl_write_ptr!(stream_on, b'V', 18, i32);
nix::ioctl_readwrite!(s_parm, b'V', 22, StreamParm);
nix::ioctl_readwrite!(g_ctrl, b'V', 27, Control);

/// Returns whether a device streams images.
pub(super) fn streams(file: &File) -> io::Result<bool> {
    let mut capability = Capability {
        driver: [0; 16],
        card: [0; 32],
        bus_info: [0; 32],
        version: 0,
        capabilities: 0,
        device_caps: 0,
        reserved: [0; 3],
    };
    // SAFETY: the request writes a `v4l2_capability`; the type above has the same layout.
    unsafe { query_cap(file.as_raw_fd(), &raw mut capability) }?;
    let caps = if capability.capabilities & HAS_DEVICE_CAPS != 0 {
        capability.device_caps
    } else {
        capability.capabilities
    };
    Ok(caps & CAN_CAPTURE != 0 && caps & CAN_STREAM != 0)
}

/// Requests a format and returns the driver's choice. Its kind differs from `kind` if the driver does not support it.
pub(super) fn set_format(file: &File, kind: Fourcc, size: [u32; 2]) -> io::Result<Pixels> {
    let pix = PixFormat {
        width: size[0],
        height: size[1],
        pixelformat: kind.code(),
        field: PROGRESSIVE,
        bytesperline: 0,
        sizeimage: 0,
        rest: [0; 44],
    };
    let mut format = Format { kind: VIDEO_CAPTURE, padding: 0, pix };
    // SAFETY: the request reads and writes a `v4l2_format`; the type above has the same layout.
    unsafe { s_fmt(file.as_raw_fd(), &raw mut format) }?;
    let found = Fourcc::ALL.into_iter().find(|f| f.code() == format.pix.pixelformat);
    // An unknown kind is represented by any kind other than `kind`.
    let other = Fourcc::ALL[usize::from(kind == Fourcc::ALL[0])];
    let bytes = if kind == Fourcc::Yuyv { 2 } else { 1 };
    let least = format.pix.width as usize * bytes;
    Ok(Pixels {
        width: format.pix.width,
        height: format.pix.height,
        stride: (format.pix.bytesperline as usize).max(least),
        kind: found.unwrap_or(other),
    })
}

/// Requests a rate and returns the driver's period; `None` if the driver does not report it. [ns]
pub(super) fn set_rate(file: &File, rate_hz: u32) -> Option<u64> {
    let mut parm = StreamParm {
        kind: VIDEO_CAPTURE,
        capability: 0,
        capturemode: 0,
        numerator: 1,
        denominator: rate_hz,
        rest: [0; 46],
    };
    // SAFETY: the request reads and writes a `v4l2_streamparm`; the type above has the same layout.
    unsafe { s_parm(file.as_raw_fd(), &raw mut parm) }.ok()?;
    let period_ns = u64::from(parm.numerator) * 1_000_000_000 / u64::from(parm.denominator).max(1);
    (1..=10_000_000_000).contains(&period_ns).then_some(period_ns)
}

/// Returns the exposure time; `None` if the camera does not report it. [ns]
pub(super) fn exposure_ns(file: &File) -> Option<u64> {
    let mut control = Control { id: EXPOSURE_ABSOLUTE, value: 0 };
    // SAFETY: the request reads and writes a `v4l2_control`; the type above has the same layout.
    unsafe { g_ctrl(file.as_raw_fd(), &raw mut control) }.ok()?;
    // The unit is 100 us.
    u64::try_from(control.value).ok().map(|value| value * 100_000)
}

/// The driver's mapped buffers of a running stream.
#[derive(Debug)]
pub(super) struct Buffers {
    file: File,
    mapped: Vec<Mmap>,
}

impl Buffers {
    /// Maps the driver's buffers and starts the stream. Closing the file ends it.
    pub(super) fn start(file: File) -> io::Result<Self> {
        let fd = file.as_raw_fd();
        let mut request = RequestBuffers {
            count: BUFFERS,
            kind: VIDEO_CAPTURE,
            memory: MMAP,
            capabilities: 0,
            flags: 0,
        };
        // SAFETY: the request reads and writes a `v4l2_requestbuffers`; the type has the same layout.
        unsafe { reqbufs(fd, &raw mut request) }?;
        let mut mapped = Vec::new();
        for index in 0..request.count {
            let mut buffer =
                Buffer { index, kind: VIDEO_CAPTURE, memory: MMAP, ..Buffer::default() };
            // SAFETY: the request reads and writes a `v4l2_buffer`; the type above has the same layout.
            unsafe { querybuf(fd, &raw mut buffer) }?;
            // The other half of the union is not written for mapped buffers.
            let offset = buffer.offset & 0xffff_ffff;
            let length = buffer.length as usize;
            // SAFETY: the memory belongs to the driver. It writes to a buffer only while the buffer is queued, and
            // `take` reads a buffer only while it is not queued.
            mapped.push(unsafe { MmapOptions::new().offset(offset).len(length).map(&file) }?);
            // SAFETY: as for `querybuf`.
            unsafe { qbuf(fd, &raw mut buffer) }?;
        }
        if mapped.is_empty() {
            return Err(io::Error::other("the driver provided no buffers"));
        }
        // SAFETY: the request reads an int.
        unsafe { stream_on(fd, &raw const STREAM_KIND) }?;
        Ok(Self { file, mapped })
    }

    /// Waits for an image, reads it in place, and returns the buffer to the driver; `None` on timeout.
    pub(super) fn take<T>(
        &mut self,
        wait: Duration,
        read: impl FnOnce(&[u8], u64, StampKind) -> T,
    ) -> io::Result<Option<T>> {
        let timeout = PollTimeout::try_from(wait).map_err(io::Error::other)?;
        let mut fds = [PollFd::new(self.file.as_fd(), PollFlags::POLLIN)];
        if poll(&mut fds, timeout)? == 0 {
            return Ok(None);
        }
        let fd = self.file.as_raw_fd();
        let mut buffer = Buffer { kind: VIDEO_CAPTURE, memory: MMAP, ..Buffer::default() };
        // SAFETY: the request reads and writes a `v4l2_buffer`; the type above has the same layout.
        unsafe { dqbuf(fd, &raw mut buffer) }?;
        let Some(memory) = self.mapped.get(buffer.index as usize) else {
            return Err(io::Error::other("the driver returned an unknown buffer"));
        };
        let bytes = &memory[..(buffer.bytesused as usize).min(memory.len())];
        let stamp_ns = buffer.seconds as u64 * 1_000_000_000 + buffer.microseconds as u64 * 1000;
        let stamped = if buffer.flags & STAMP_SOURCE == EXPOSURE_BEGAN {
            StampKind::ExposureBegan
        } else {
            StampKind::LastByte
        };
        let result = read(bytes, stamp_ns, stamped);
        // SAFETY: as for `dqbuf`; the slice is no longer used.
        unsafe { qbuf(fd, &raw mut buffer) }?;
        Ok(Some(result))
    }
}

const VIDEO_CAPTURE: u32 = 1;
static STREAM_KIND: i32 = VIDEO_CAPTURE as i32;
const MMAP: u32 = 1;
const PROGRESSIVE: u32 = 1;
const CAN_CAPTURE: u32 = 1;
const CAN_STREAM: u32 = 0x0400_0000;
const HAS_DEVICE_CAPS: u32 = 0x8000_0000;
const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
const STAMP_SOURCE: u32 = 0x0007_0000;
const EXPOSURE_BEGAN: u32 = 0x0001_0000;
/// Number of buffers: one is filled, one is full, one is read, and one is spare.
const BUFFERS: u32 = 4;
