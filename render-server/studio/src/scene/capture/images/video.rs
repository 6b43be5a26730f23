//! Reads a video with the programs ffmpeg and ffprobe, and stores the sharpest picture of each time interval.

use std::io::{ErrorKind, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, anyhow, bail, ensure};
use vizflyt_rgbd::encode_jpeg;
use vizflyt_tags::capture::{Colours, Y4m};

use super::blur::blur;
use super::choose::Buckets;
use super::photos::mean;
use super::{Choice, Picture, Pictures};
use crate::scene::progress::Progress;

/// Sharpest picture of the current interval.
struct Best {
    at_s: f64,
    blur: f64,
    image: Colours,
}

/// Writes the sharpest picture of each time interval of a video into `folder`.
pub(super) fn take(file: &Path, choice: Choice, folder: &Path) -> Result<Pictures> {
    let duration_s = probe(file)?;
    let buckets = Buckets::new(duration_s, choice);
    let mut decoder = Decoder::start(file, choice.width_px)?;
    let mut progress = Progress::new("");
    let mut best: Option<(usize, Best)> = None;
    let mut pictures = Vec::new();
    let mut size_px = [0; 2];
    let mut number = 0u64;
    while let Some((rate_hz, image)) = decoder.next()? {
        let at_s = number as f64 / rate_hz;
        number += 1;
        progress.show(at_s / duration_s, || {
            format!("looking at {at_s:.0} of {duration_s:.0} s of the video")
        });
        let Some(bucket) = buckets.find(at_s, rate_hz) else { continue };
        size_px = [image.width_px, image.height_px];
        let blur = blur(size_px[0] as usize, size_px[1] as usize, image.luma());
        match &mut best {
            Some((of, found)) if *of == bucket => {
                if blur < found.blur {
                    *found = Best { at_s, blur, image };
                }
            }
            _ => {
                let before = best.replace((bucket, Best { at_s, blur, image }));
                if let Some((_, before)) = before {
                    pictures.push(write(&before, pictures.len(), folder)?);
                }
            }
        }
    }
    if let Some((_, last)) = best {
        pictures.push(write(&last, pictures.len(), folder)?);
    }
    ensure!(
        pictures.len() >= LEAST_PICTURES,
        "{} yields {} pictures; film for half a minute or longer",
        file.display(),
        pictures.len()
    );
    Ok(Pictures { folder: folder.to_owned(), size_px, of_video: true, pictures })
}

/// Writes a picture as JPEG.
fn write(best: &Best, number: usize, folder: &Path) -> Result<Picture> {
    let name = format!("{number:05}.jpg");
    let path = folder.join(&name);
    let Best { at_s, blur, image } = best;
    let count = image.luma().len();
    let (luma, chroma) = image.planes.split_at(count);
    let (cb, cr) = chroma.split_at(count);
    let rgb: Vec<u8> =
        luma.iter().zip(cb).zip(cr).flat_map(|((&y, &cb), &cr)| rgb([y, cb, cr])).collect();
    let mut bytes = Vec::new();
    encode_jpeg(&rgb, image.width_px, image.height_px, JPEG_QUALITY, &mut bytes)
        .with_context(|| format!("cannot encode {}", path.display()))?;
    std::fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Picture { name, at_s: *at_s, blur: *blur, grey: mean(luma) })
}

/// Converts full-range YCbCr to RGB (ITU-T T.871, 7).
fn rgb([y, cb, cr]: [u8; 3]) -> [u8; 3] {
    let [y, cb, cr] = [f32::from(y), f32::from(cb) - 128.0, f32::from(cr) - 128.0];
    [y + 1.402 * cr, y - 0.344136 * cb - 0.714136 * cr, y + 1.772 * cb]
        .map(|value| (value + 0.5) as u8)
}

/// Returns the duration of a video. [s]
///
/// # Errors
/// The file is not a video, or ffprobe is not installed.
pub(in super::super) fn probe(file: &Path) -> Result<f64> {
    let mut command = Command::new("ffprobe");
    command.args(["-v", "error", "-select_streams", "v:0"]);
    command.args(["-show_entries", "stream=duration:format=duration", "-of", "json"]).arg(file);
    let output =
        command.stdin(Stdio::null()).output().map_err(|error| absent("ffprobe", &error))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        bail!("ffmpeg cannot read {} as a video: {}", file.display(), said.trim());
    }
    duration_s(&output.stdout)
        .with_context(|| format!("{}: ffprobe finds no video with a duration", file.display()))
}

/// Returns the duration from ffprobe's output: that of the video stream, otherwise that of the file. [s]
fn duration_s(json: &[u8]) -> Option<f64> {
    let json: serde_json::Value = serde_json::from_slice(json).ok()?;
    let number = |value: &serde_json::Value| value["duration"].as_str()?.parse::<f64>().ok();
    let stream = json["streams"].as_array()?.first()?;
    let found = number(stream).or_else(|| number(&json["format"]));
    found.filter(|seconds| *seconds > 0.0 && *seconds < 1e6)
}

fn absent(program: &str, error: &std::io::Error) -> anyhow::Error {
    if error.kind() == ErrorKind::NotFound {
        return anyhow!(
            "a video is read by the program {program}, which is not installed; run `apt-get install ffmpeg`, \
             or give a folder of photos"
        );
    }
    anyhow!("cannot start {program}: {error}")
}

/// Running ffmpeg process and its output.
struct Decoder {
    ffmpeg: Child,
    stream: Y4m,
    buffer: Vec<u8>,
}

impl Decoder {
    fn start(file: &Path, width_px: u32) -> Result<Self> {
        let mut command = Command::new("ffmpeg");
        command.args(["-nostdin", "-v", "error", "-i"]).arg(file).args(["-map", "0:v:0", "-vf"]);
        // Colour space of JPEG: BT.601, full range.
        command.arg(format!(
            "scale=w='min({width_px},iw)':h=-2:out_color_matrix=bt601:out_range=full,format=yuv444p"
        ));
        command.args(["-f", "yuv4mpegpipe", "-strict", "-1", "-"]);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let ffmpeg = command.spawn().map_err(|error| absent("ffmpeg", &error))?;
        Ok(Self { ffmpeg, stream: Y4m::default(), buffer: vec![0; 1 << 18] })
    }

    /// Returns the next picture and the frame rate [Hz]; `None` at the end.
    fn next(&mut self) -> Result<Option<(f64, Colours)>> {
        loop {
            if let Some(image) = self.stream.poll_colours().map_err(anyhow::Error::msg)? {
                return Ok(Some((self.stream.rate_hz().unwrap_or(30.0), image)));
            }
            let Some(out) = &mut self.ffmpeg.stdout else { return Ok(None) };
            match out.read(&mut self.buffer) {
                Ok(0) => {
                    self.ffmpeg.stdout = None;
                    let status = self.ffmpeg.wait().context("cannot wait for ffmpeg")?;
                    ensure!(status.success(), "ffmpeg cannot read the video: {}", self.said());
                    return Ok(None);
                }
                Ok(count) => self.stream.push(&self.buffer[..count]),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error).context("cannot read from ffmpeg"),
            }
        }
    }

    fn said(&mut self) -> String {
        let mut said = String::new();
        if let Some(mut stderr) = self.ffmpeg.stderr.take() {
            // A read error must not hide the output that was read.
            let _ = stderr.read_to_string(&mut said);
        }
        said.trim().to_owned()
    }
}

impl Drop for Decoder {
    fn drop(&mut self) {
        // These have no effect on a process that has ended.
        let _ = self.ffmpeg.kill();
        let _ = self.ffmpeg.wait();
    }
}

/// Quality at which block artefacts are hardly visible.
const JPEG_QUALITY: u8 = 95;
/// Minimum number of pictures.
const LEAST_PICTURES: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prefers_the_duration_of_the_stream() {
        let of = |text: &str| duration_s(text.as_bytes());
        let stream =
            r#"{"programs":[],"streams":[{"duration":"50.000000"}],"format":{"duration":"50.1"}}"#;
        assert_eq!(of(stream), Some(50.0));
        assert_eq!(of(r#"{"streams":[{}],"format":{"duration":"7.5"}}"#), Some(7.5));
        for none in [
            r#"{"streams":[],"format":{"duration":"50.1"}}"#,
            r#"{"streams":[{"duration":"N/A"}],"format":{}}"#,
            r#"{"streams":[{"duration":"-3"}],"format":{}}"#,
            "",
        ] {
            assert_eq!(of(none), None, "{none}");
        }
    }
}
