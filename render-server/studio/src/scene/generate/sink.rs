//! Output of a capture: a folder of JPEG images, or a video. The program ffmpeg encodes the video from raw images on
//! its standard input.

use std::fmt;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, anyhow, bail};
use vizflyt_rgbd::encode_jpeg;

/// Target of a capture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Target {
    Video(PathBuf),
    /// Folder of images.
    Folder(PathBuf),
}

impl Target {
    /// Returns the target of a path: a video if it has a video's extension, otherwise a folder.
    ///
    /// # Errors
    /// The path has the extension of another file type.
    pub(super) fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().and_then(|ending| ending.to_str()).map(str::to_lowercase);
        match ending.as_deref() {
            _ if path.is_dir() => Ok(Self::Folder(path.to_owned())),
            Some("mp4" | "mkv" | "mov") => Ok(Self::Video(path.to_owned())),
            // A path with a trailing slash is a folder, for example `images.v2/`.
            None => Ok(Self::Folder(path.to_owned())),
            _ if path.as_os_str().to_string_lossy().ends_with('/') => {
                Ok(Self::Folder(path.to_owned()))
            }
            Some(ending) => bail!(
                "--capture {}: no video ends with .{ending}; give .mp4, .mkv or .mov, or a folder for images",
                path.display()
            ),
        }
    }

    /// Returns the path of the file with the true poses.
    pub(super) fn truth_file(&self) -> PathBuf {
        self.beside("truth.json")
    }

    /// Returns the path of the lens file.
    pub(super) fn camera_file(&self) -> PathBuf {
        self.beside("camera.toml")
    }

    /// Returns the path of the layout of tags.
    pub(super) fn tags_file(&self) -> PathBuf {
        self.beside("tags.toml")
    }

    /// Returns the file name of an image; `None` for a video.
    pub(super) fn image_name(&self, number: usize) -> Option<String> {
        matches!(self, Self::Folder(_)).then(|| format!("{number:05}.jpg"))
    }

    fn beside(&self, name: &str) -> PathBuf {
        match self {
            Self::Video(file) => file.with_extension(name),
            Self::Folder(folder) => folder.join(name),
        }
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Video(path) | Self::Folder(path) => path.display().fmt(f),
        }
    }
}

/// Writer of images, in order.
pub(super) struct Sink {
    target: Target,
    size_px: [u32; 2],
    video: Option<Encoding>,
}

/// Running ffmpeg process.
struct Encoding {
    ffmpeg: Child,
    /// Temporary file, renamed when the video is complete.
    part: PathBuf,
}

impl Sink {
    /// Opens the target.
    ///
    /// # Errors
    /// ffmpeg is not installed, or the folder cannot be created.
    pub(super) fn open(target: &Target, size_px: [u32; 2], rate_hz: u32) -> Result<Self> {
        let video = match target {
            Target::Video(file) => Some(Encoding::start(file, size_px, rate_hz)?),
            Target::Folder(folder) => {
                std::fs::create_dir_all(folder)
                    .with_context(|| format!("cannot make the folder {}", folder.display()))?;
                None
            }
        };
        Ok(Self { target: target.clone(), size_px, video })
    }

    /// Writes an image of H x W x 3 bytes.
    ///
    /// # Errors
    /// ffmpeg fails, or a file cannot be written.
    pub(super) fn write(&mut self, number: usize, rgb: &[u8]) -> Result<()> {
        if let Some(video) = &mut self.video {
            let written = video.ffmpeg.stdin.as_mut().map(|pipe| pipe.write_all(rgb));
            return match written {
                Some(Ok(())) => Ok(()),
                // ffmpeg has ended; the error contains its output.
                _ => Err(video.failure()),
            };
        }
        let Some(name) = self.target.image_name(number) else { return Ok(()) };
        let Target::Folder(folder) = &self.target else { return Ok(()) };
        let path = folder.join(name);
        let [width, height] = self.size_px;
        let mut bytes = Vec::new();
        encode_jpeg(rgb, width, height, JPEG_QUALITY, &mut bytes)
            .with_context(|| format!("cannot encode {}", path.display()))?;
        std::fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Completes the output.
    ///
    /// # Errors
    /// ffmpeg fails, or a file cannot be written.
    pub(super) fn finish(mut self) -> Result<()> {
        let (Some(video), Target::Video(file)) = (&mut self.video, &self.target) else {
            return Ok(());
        };
        drop(video.ffmpeg.stdin.take());
        if !video.ffmpeg.wait().context("cannot wait for ffmpeg")?.success() {
            return Err(video.failure());
        }
        std::fs::rename(&video.part, file)
            .with_context(|| format!("cannot write {}", file.display()))?;
        self.video = None;
        Ok(())
    }
}

impl Encoding {
    fn start(file: &Path, [width, height]: [u32; 2], rate_hz: u32) -> Result<Self> {
        let ending = file.extension().and_then(|ending| ending.to_str()).unwrap_or("mp4");
        let part = file.with_extension(format!("part.{ending}"));
        let mut command = Command::new("ffmpeg");
        command.args(["-nostdin", "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-video_size", &format!("{width}x{height}")]);
        command.args(["-framerate", &rate_hz.to_string(), "-i", "-"]);
        // H.264 with 4:2:0 colour, as phones use it; a video of a hall at 640x480 has 1 Mbit/s.
        command
            .args(["-c:v", "libx264", "-preset", "veryfast", "-crf", "19", "-pix_fmt", "yuv420p"]);
        command.arg(&part);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let ffmpeg = command.spawn().map_err(|error| match error.kind() {
            ErrorKind::NotFound => anyhow!(
                "a video is encoded by the program ffmpeg, which is not installed; run `apt-get install ffmpeg`, \
                 or give --capture a folder for images"
            ),
            _ => anyhow!("cannot start ffmpeg: {error}"),
        })?;
        Ok(Self { ffmpeg, part })
    }

    /// Returns the error output of ffmpeg.
    fn failure(&mut self) -> anyhow::Error {
        drop(self.ffmpeg.stdin.take());
        let mut said = String::new();
        if let Some(mut stderr) = self.ffmpeg.stderr.take() {
            // A read error must not hide the output that was read.
            let _ = stderr.read_to_string(&mut said);
        }
        anyhow!("ffmpeg cannot encode {}: {}", self.part.display(), said.trim())
    }
}

impl Drop for Encoding {
    fn drop(&mut self) {
        // These have no effect after a successful end.
        let _ = self.ffmpeg.kill();
        let _ = self.ffmpeg.wait();
        let _ = std::fs::remove_file(&self.part);
    }
}

/// Quality as of phones; block artefacts are hardly visible.
const JPEG_QUALITY: u8 = 95;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distinguishes_videos_from_folders() {
        let of = |path: &str| Target::of(Path::new(path)).map_err(|error| error.to_string());
        assert_eq!(of("a/hall.mp4"), Ok(Target::Video("a/hall.mp4".into())));
        assert_eq!(of("hall.MOV"), Ok(Target::Video("hall.MOV".into())));
        assert_eq!(of("images"), Ok(Target::Folder("images".into())));
        assert_eq!(of("images.v2/"), Ok(Target::Folder("images.v2/".into())));
        assert!(of("hall.jpg").unwrap_err().contains(".mp4, .mkv or .mov"));
        let [video, folder] = ["a/hall.mp4", "images"].map(|path| of(path).unwrap());
        assert_eq!(video.truth_file(), Path::new("a/hall.truth.json"));
        assert_eq!(folder.tags_file(), Path::new("images/tags.toml"));
        assert_eq!((video.image_name(3), folder.image_name(3)), (None, Some("00003.jpg".into())));
    }
}
