//! YUV4MPEG2: raw images on a pipe, as written by `ffmpeg -f yuv4mpegpipe` and GStreamer's `y4menc` (mjpegtools,
//! yuv4mpeg(5)). Returns the brightness, or optionally the colours.

use super::decode::check;
use crate::image::Gray;

/// Splits a stream of bytes into images.
///
/// ```
/// let mut stream = vizflyt_tags::capture::Y4m::default();
/// stream.push(b"YUV4MPEG2 W2 H1 F30:1 Cmono\nFRAME XSTAMP_NS=7\n\x10\x20");
/// let (stamp_ns, image) = stream.poll().unwrap().unwrap();
/// assert_eq!((stamp_ns, image.pixels()), (Some(7), &[0x10, 0x20][..]));
/// assert_eq!(stream.rate_hz(), Some(30.0));
/// ```
#[derive(Debug, Default)]
pub struct Y4m {
    bytes: Vec<u8>,
    head: Option<Head>,
    /// Header of the image that is being received.
    image: Option<ImageHead>,
}

/// Header of an image.
#[derive(Clone, Copy, Debug)]
struct ImageHead {
    stamp_ns: Option<u64>,
}

#[derive(Clone, Copy, Debug)]
struct Head {
    width: u32,
    height: u32,
    chroma: usize,
    rate_hz: Option<f64>,
}

/// Header, stamp [ns] and bytes of an image.
type Planes = (Head, Option<u64>, Vec<u8>);

impl Head {
    fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// An image with its colours.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Colours {
    /// Width. [px]
    pub width_px: u32,
    /// Height. [px]
    pub height_px: u32,
    /// Planes Y, Cb, Cr, H x W bytes each.
    pub planes: Vec<u8>,
}

impl Colours {
    /// Returns the plane of brightness, H x W.
    pub fn luma(&self) -> &[u8] {
        &self.planes[..self.planes.len() / 3]
    }
}

impl Y4m {
    /// Adds received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    /// Returns the frame rate in the header; `None` before the header, or if it has no rate.
    pub fn rate_hz(&self) -> Option<f64> {
        self.head.and_then(|head| head.rate_hz)
    }

    /// Returns the next complete image and its `XSTAMP_NS`; `None` if bytes are missing.
    ///
    /// # Errors
    /// A message about the problem; the stream cannot be continued.
    pub fn poll(&mut self) -> Result<Option<(Option<u64>, Gray)>, String> {
        let Some((head, stamp_ns, mut planes)) = self.planes()? else { return Ok(None) };
        planes.truncate(head.pixels());
        let image = Gray::new(head.width, head.height, planes);
        Ok(image.map(|image| (stamp_ns, image)))
    }

    /// Returns the next complete image with its colours, from a `C444` stream: one plane each of Y, Cb and Cr, H x W.
    /// `None` if bytes are missing. Each image is returned either by this function or by [`Self::poll`].
    ///
    /// # Errors
    /// As [`Self::poll`], and if the stream is not `C444`.
    pub fn poll_colours(&mut self) -> Result<Option<Colours>, String> {
        let Some((head, _, planes)) = self.planes()? else { return Ok(None) };
        if head.chroma != 2 * head.pixels() {
            return Err("the stream's colours are coarser than its pixels; write yuv444p".into());
        }
        Ok(Some(Colours { width_px: head.width, height_px: head.height, planes }))
    }

    /// Removes and returns the bytes of the next image.
    fn planes(&mut self) -> Result<Option<Planes>, String> {
        let head = match self.head {
            Some(head) => head,
            None => match self.line()? {
                Some(line) => *self.head.insert(parse_head(&line)?),
                None => return Ok(None),
            },
        };
        let ImageHead { stamp_ns } = match self.image {
            Some(head) => head,
            None => match self.line()? {
                Some(line) => *self.image.insert(parse_image(&line)?),
                None => return Ok(None),
            },
        };
        let count = head.pixels() + head.chroma;
        if self.bytes.len() < count {
            return Ok(None);
        }
        let planes = self.bytes.drain(..count).collect();
        self.image = None;
        Ok(Some((head, stamp_ns, planes)))
    }

    /// Removes and returns a line without its end.
    fn line(&mut self) -> Result<Option<String>, String> {
        let Some(end) = self.bytes.iter().take(MAX_LINE).position(|&b| b == b'\n') else {
            if self.bytes.len() >= MAX_LINE {
                return Err(
                    "not a YUV4MPEG2 stream; write it with ffmpeg or GStreamer's y4menc".into()
                );
            }
            return Ok(None);
        };
        let line = String::from_utf8_lossy(&self.bytes[..end]).into_owned();
        self.bytes.drain(..=end);
        Ok(Some(line))
    }
}

fn parse_head(line: &str) -> Result<Head, String> {
    let mut words = line.split(' ');
    if words.next() != Some("YUV4MPEG2") {
        return Err("not a YUV4MPEG2 stream; write it with ffmpeg or GStreamer's y4menc".into());
    }
    let (mut width, mut height, mut rate_hz, mut colours) = (0, 0, None, "420");
    for word in words.filter(|word| !word.is_empty()) {
        let Some((tag, value)) = word.split_at_checked(1) else { continue };
        match tag {
            "W" => width = value.parse().map_err(|_| format!("width {value:?} is not a number"))?,
            "H" => {
                height = value.parse().map_err(|_| format!("height {value:?} is not a number"))?;
            }
            "F" => rate_hz = parse_rate(value),
            "C" => colours = value,
            _ => {}
        }
    }
    check(width, height)?;
    let (across, down) = (width.div_ceil(2) as usize, height.div_ceil(2) as usize);
    let (width_px, height_px) = (width as usize, height as usize);
    let chroma = match colours {
        "mono" => 0,
        "420" | "420jpeg" | "420mpeg2" | "420paldv" => 2 * across * down,
        "422" => 2 * across * height_px,
        "444" => 2 * width_px * height_px,
        "444alpha" => 3 * width_px * height_px,
        other => {
            return Err(format!("colours {other:?} are unknown; write mono or 420, of 8 bits"));
        }
    };
    Ok(Head { width, height, chroma, rate_hz })
}

fn parse_rate(value: &str) -> Option<f64> {
    let (images, seconds) = value.split_once(':')?;
    let rate_hz = images.parse::<f64>().ok()? / seconds.parse::<f64>().ok()?;
    (rate_hz > 0.0 && rate_hz.is_finite()).then_some(rate_hz)
}

fn parse_image(line: &str) -> Result<ImageHead, String> {
    let mut words = line.split(' ');
    if words.next() != Some("FRAME") {
        return Err(
            "an image does not begin at the end of the previous one: bytes are missing".into()
        );
    }
    let mut stamps = words.filter_map(|word| word.strip_prefix("XSTAMP_NS="));
    Ok(ImageHead { stamp_ns: stamps.find_map(|ns| ns.parse().ok()) })
}

/// Maximum length of a header; typical are 60 bytes.
const MAX_LINE: usize = 1024;
