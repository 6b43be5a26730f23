//! Images from a pipe: standard input, a command, or ffmpeg for a video file.

use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::{CaptureError, Exposure, ImageSource, Y4m, now_ns};

/// Reader of a YUV4MPEG2 stream.
pub struct Pipe {
    name: String,
    reader: Box<dyn Read + Send>,
    stream: Y4m,
    /// Process that writes the stream; killed with this source.
    child: Option<Child>,
    /// Whether stamps are computed from the stream's rate; otherwise images are stamped on arrival.
    is_recorded: bool,
    count: u64,
    buffer: Vec<u8>,
}

impl Pipe {
    /// Reads standard input.
    pub fn stdin() -> Self {
        Self::new("standard input", Box::new(std::io::stdin()), None, false)
    }

    /// Runs a shell command and reads its output.
    ///
    /// # Errors
    /// [`CaptureError::Io`] if the shell cannot be started.
    pub fn command(command: &str) -> Result<Self, CaptureError> {
        let mut shell = Command::new("sh");
        shell.args(["-c", command]);
        Self::spawn(command, shell, false)
    }

    /// Reads a video file through the program `ffmpeg`.
    ///
    /// # Errors
    /// [`CaptureError`] if ffmpeg is not installed.
    pub fn video(path: &Path) -> Result<Self, CaptureError> {
        let mut ffmpeg = Command::new("ffmpeg");
        ffmpeg.args(["-nostdin", "-v", "error", "-i"]).arg(path);
        ffmpeg.args([
            "-map",
            "0:v:0",
            "-pix_fmt",
            "gray",
            "-f",
            "yuv4mpegpipe",
            "-strict",
            "-1",
            "-",
        ]);
        Self::spawn(&path.display().to_string(), ffmpeg, true).map_err(|error| match error {
            CaptureError::Io { source_name, error }
                if error.kind() == std::io::ErrorKind::NotFound =>
            {
                let why = "video files need the program ffmpeg, which is not installed; \
                           `apt-get install ffmpeg` installs it";
                CaptureError::unfit(source_name, why)
            }
            other => other,
        })
    }

    fn spawn(name: &str, mut command: Command, is_recorded: bool) -> Result<Self, CaptureError> {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| CaptureError::io(name, error))?;
        let Some(out) = child.stdout.take() else {
            return Err(CaptureError::unfit(name, "its output cannot be read"));
        };
        Ok(Self::new(name, Box::new(out), Some(child), is_recorded))
    }

    fn new(
        name: &str,
        reader: Box<dyn Read + Send>,
        child: Option<Child>,
        is_recorded: bool,
    ) -> Self {
        Self {
            name: name.to_owned(),
            reader,
            stream: Y4m::default(),
            child,
            is_recorded,
            count: 0,
            buffer: vec![0; 1 << 16],
        }
    }

    /// Handles the end of a stream. A failed program has already printed its own error.
    fn ended(&mut self) -> Result<Option<Exposure>, CaptureError> {
        if let Some(mut child) = self.child.take() {
            let status = child.wait().map_err(|error| CaptureError::io(&self.name, error))?;
            if !status.success() {
                let why = format!("ended with {status} after {} images", self.count);
                return Err(CaptureError::unfit(&self.name, why));
            }
        }
        if self.count == 0 {
            return Err(CaptureError::unfit(&self.name, "no image in it"));
        }
        Ok(None)
    }
}

impl ImageSource for Pipe {
    fn next(&mut self) -> Result<Option<Exposure>, CaptureError> {
        loop {
            let polled = self.stream.poll().map_err(|why| CaptureError::unfit(&self.name, why))?;
            if let Some((stamp_ns, image)) = polled {
                let stamp_ns = stamp_ns.unwrap_or_else(|| {
                    if self.is_recorded {
                        let rate_hz = self.stream.rate_hz().unwrap_or(30.0);
                        (self.count as f64 / rate_hz * 1e9) as u64
                    } else {
                        now_ns()
                    }
                });
                self.count += 1;
                return Ok(Some(Exposure { stamp_ns, image }));
            }
            match self.reader.read(&mut self.buffer) {
                Ok(0) => return self.ended(),
                Ok(count) => self.stream.push(&self.buffer[..count]),
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Err(error) => return Err(CaptureError::io(&self.name, error)),
            }
        }
    }

    fn is_live(&self) -> bool {
        !self.is_recorded
    }
}

impl Drop for Pipe {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            // The process may have ended already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
