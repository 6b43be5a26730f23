//! A folder of images.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::{CaptureError, Exposure, ImageSource, decode};

/// Returns the images of a folder in the order of their names.
///
/// Stamps come from `stamps.csv` (lines of `name,stamp_ns`), or from names of at least 16 digits (nanoseconds). Without
/// either, images are [`Folder::PERIOD_NS`] apart.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    /// Remaining names and stamps, the next one last.
    rest: Vec<(String, u64)>,
}

impl Folder {
    /// Interval of images without stamps: 30 Hz.
    pub const PERIOD_NS: u64 = 33_333_333;

    /// Lists a folder.
    ///
    /// # Errors
    /// [`CaptureError`] if it cannot be read, has no images, or `stamps.csv` is damaged.
    pub fn open(path: &Path) -> Result<Self, CaptureError> {
        let named = || path.display().to_string();
        let io = |error| CaptureError::io(named(), error);
        let mut names = Vec::new();
        for entry in std::fs::read_dir(path).map_err(io)? {
            if let Ok(name) = entry.map_err(io)?.file_name().into_string()
                && is_image(&name)
            {
                names.push(name);
            }
        }
        if names.is_empty() {
            return Err(CaptureError::unfit(named(), "no .png, .jpg or .pgm files in it"));
        }
        // Sort by number: 9.png before 10.png.
        names.sort_by(|a, b| (digits(a), a).cmp(&(digits(b), b)));
        let table = path.join("stamps.csv");
        let stamps = match std::fs::read_to_string(&table) {
            Ok(text) => parse_stamps(&text)
                .map_err(|why| CaptureError::unfit(table.display().to_string(), why))?,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => HashMap::new(),
            Err(error) => return Err(CaptureError::io(table.display().to_string(), error)),
        };
        let mut rest = Vec::with_capacity(names.len());
        for (index, name) in names.into_iter().enumerate() {
            let stamp_ns = if stamps.is_empty() {
                stem_ns(&name).unwrap_or(index as u64 * Self::PERIOD_NS)
            } else {
                *stamps.get(&name).ok_or_else(|| {
                    CaptureError::unfit(table.display().to_string(), format!("no line for {name}"))
                })?
            };
            rest.push((name, stamp_ns));
        }
        rest.reverse();
        Ok(Self { path: path.to_owned(), rest })
    }
}

impl ImageSource for Folder {
    fn next(&mut self) -> Result<Option<Exposure>, CaptureError> {
        let Some((name, stamp_ns)) = self.rest.pop() else { return Ok(None) };
        let path = self.path.join(name);
        let bytes = std::fs::read(&path)
            .map_err(|error| CaptureError::io(path.display().to_string(), error))?;
        // Unlike a network stream, a folder should be complete: a damaged file is an error and is not skipped.
        let image =
            decode(&bytes).map_err(|why| CaptureError::unfit(path.display().to_string(), why))?;
        Ok(Some(Exposure { stamp_ns, image }))
    }

    fn is_live(&self) -> bool {
        false
    }
}

/// Parses `stamps.csv`: lines of a file name and its stamp in nanoseconds, with an optional header.
///
/// # Errors
/// A message with the number of the invalid line.
///
/// ```
/// let stamps = vizflyt_tags::capture::parse_stamps("name,stamp_ns\n1.png,5000\n").unwrap();
/// assert_eq!(stamps["1.png"], 5000);
/// ```
pub fn parse_stamps(text: &str) -> Result<HashMap<String, u64>, String> {
    let mut stamps = HashMap::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || (index == 0 && line.replace(' ', "") == "name,stamp_ns") {
            continue;
        }
        let parsed = line
            .rsplit_once(',')
            .and_then(|(name, stamp)| Some((name.trim(), stamp.trim().parse().ok()?)));
        let Some((name, stamp_ns)) = parsed else {
            return Err(format!("line {}: {line:?} is not `name,stamp_ns`", index + 1));
        };
        if stamps.insert(name.to_owned(), stamp_ns).is_some() {
            return Err(format!("line {}: {name} is there twice", index + 1));
        }
    }
    Ok(stamps)
}

fn is_image(name: &str) -> bool {
    let Some((_, ending)) = name.rsplit_once('.') else { return false };
    ["png", "jpg", "jpeg", "pgm"].iter().any(|known| ending.eq_ignore_ascii_case(known))
}

/// Returns the number of leading digits in a name; names without digits are sorted last.
fn digits(name: &str) -> usize {
    match name.bytes().take_while(u8::is_ascii_digit).count() {
        0 => usize::MAX,
        count => count,
    }
}

/// Returns the stamp in a name, if it has enough digits for nanoseconds.
fn stem_ns(name: &str) -> Option<u64> {
    let (stem, _) = name.rsplit_once('.')?;
    (stem.len() >= 16).then(|| stem.parse().ok())?
}
