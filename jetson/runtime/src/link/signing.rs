//! Signing on this link: the key file, and rejected packets.
//!
//! The key is 64 hexadecimal digits in a file that only its owner can read. A second file next to it stores the time
//! stamp from which the next run starts, so that a computer with a reset clock does not reuse stamps that the autopilot
//! has already seen.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use vizflyt_protocol::mavlink::dialect::MavMessage;
use vizflyt_protocol::mavlink::{
    MAX_PACKET, Signer, SigningFault, SigningKey, SigningTime, Verifier,
};
use vizflyt_protocol::time::HostTime;

use super::LinkSigning;

/// Signs and verifies packets.
#[derive(Clone, Debug)]
pub(super) struct Signatures {
    signer: Signer,
    verifier: Verifier,
    made_at: HostTime,
    start: SigningTime,
    accepts_unsigned: bool,
    /// Rejected packets by fault.
    refused: Vec<Refused>,
}

/// Packets rejected for one fault.
#[derive(Clone, Copy, Debug)]
struct Refused {
    fault: SigningFault,
    count: u64,
    /// Number of packets already reported.
    reported: u64,
    /// Time of the next report.
    due_at: HostTime,
    /// Time between that report and the one after it. [s]
    pause_s: f64,
}

/// Time between the first and the second report of a fault; each further interval is twice as long. [s]
const FIRST_PAUSE_S: f64 = 10.0;

impl Signatures {
    pub(super) fn new(now: HostTime, signing: LinkSigning) -> Self {
        Self {
            signer: Signer::new(signing.key.clone(), 0),
            verifier: Verifier::new(signing.key),
            made_at: now,
            start: signing.start,
            accepts_unsigned: signing.accepts_unsigned,
            refused: Vec::new(),
        }
    }

    fn time(&self, now: HostTime) -> SigningTime {
        self.start.plus_us((now.seconds_since(self.made_at).max(0.0) * 1e6) as u64)
    }

    pub(super) fn sign(
        &mut self,
        now: HostTime,
        buffer: &mut [u8; MAX_PACKET],
        len: usize,
    ) -> usize {
        let time = self.time(now);
        self.signer.sign(time, buffer, len)
    }

    /// Whether a packet is accepted. RADIO_STATUS is accepted unsigned, because a bridge has no key (MAVLink guide,
    /// "Accepting Unsigned Packets").
    pub(super) fn accepts(&mut self, now: HostTime, bytes: &[u8], message: &MavMessage) -> bool {
        if self.accepts_unsigned || matches!(message, MavMessage::RADIO_STATUS(_)) {
            return true;
        }
        let time = self.time(now);
        match self.verifier.check(time, bytes) {
            Ok(()) => true,
            Err(fault) => {
                self.refuse(now, fault);
                false
            }
        }
    }

    fn refuse(&mut self, now: HostTime, fault: SigningFault) {
        if let Some(refused) = self.refused.iter_mut().find(|refused| refused.fault == fault) {
            refused.count += 1;
        } else {
            let (count, pause_s) = (1, FIRST_PAUSE_S);
            self.refused.push(Refused { fault, count, reported: 0, due_at: now, pause_s });
        }
    }

    pub(super) fn refused(&self) -> u64 {
        self.refused.iter().map(|refused| refused.count).sum()
    }

    /// Returns a fault to report at `now` and its number of packets: each fault at once, then at growing intervals, and
    /// only after further packets.
    pub(super) fn poll_refused(&mut self, now: HostTime) -> Option<(SigningFault, u64)> {
        let is_due =
            |refused: &&mut Refused| refused.count > refused.reported && now >= refused.due_at;
        let refused = self.refused.iter_mut().find(is_due)?;
        refused.reported = refused.count;
        refused.due_at = now.plus_seconds(refused.pause_s);
        refused.pause_s *= 2.0;
        Some((refused.fault, refused.count))
    }
}

/// Key file.
#[derive(Clone, Debug)]
pub struct SigningFile {
    path: PathBuf,
}

/// Why the key file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SigningFileError {
    /// Reading or writing failed.
    #[error("{path}: {why}", path = .path.display())]
    Unusable {
        path: PathBuf,
        /// Error of the operating system.
        why: std::io::Error,
    },
    /// The file does not contain a key.
    #[error(
        "{path} contains no key of 64 hexadecimal digits; create one with `vizflyt vehicle sign`",
        path = .path.display()
    )]
    NoKey { path: PathBuf },
    /// Other users can read the file.
    #[error("{path} can be read by others; `chmod 600` it, and create a new key", path = .path.display())]
    Open { path: PathBuf },
}

/// Added to the last stamp if the clock was reset: longer than a flight. [us]
const RESERVE_US: u64 = 3_600_000_000;

impl SigningFile {
    /// Creates a handle for a file; reads nothing.
    pub fn new(path: &Path) -> Self {
        Self { path: path.to_owned() }
    }

    /// Writes a new key file.
    ///
    /// # Errors
    /// Fails if the file exists or cannot be written.
    pub fn create(&self, key: &SigningKey) -> Result<(), SigningFileError> {
        let hex = vizflyt_trust::hex(key.bytes());
        let written = OpenOptions::new()
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(&self.path)
            .and_then(|mut file| file.write_all((hex + "\n").as_bytes()));
        written.map_err(|why| self.unusable(why))
    }

    /// Reads the key and determines the first time stamp of this run.
    ///
    /// # Errors
    /// Fails if there is no key, other users can read it, or the stamp cannot be stored.
    pub fn open(&self) -> Result<LinkSigning, SigningFileError> {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.open_at(SigningTime::from_unix_us(since_1970.as_micros() as u64))
    }

    fn open_at(&self, wall: SigningTime) -> Result<LinkSigning, SigningFileError> {
        let meta = fs::metadata(&self.path).map_err(|why| self.unusable(why))?;
        if meta.permissions().mode() & 0o077 != 0 {
            return Err(SigningFileError::Open { path: self.path.clone() });
        }
        let text = fs::read_to_string(&self.path).map_err(|why| self.unusable(why))?;
        let key = key_from_hex(text.trim())
            .ok_or_else(|| SigningFileError::NoKey { path: self.path.clone() })?;
        let stamp_path = self.path.with_extension("stamp");
        let last = fs::read_to_string(&stamp_path).ok().and_then(|text| text.trim().parse().ok());
        let last = SigningTime::from_units(last.unwrap_or(0));
        let start = if wall > last { wall } else { last.plus_us(RESERVE_US) };
        fs::write(&stamp_path, start.units().to_string())
            .map_err(|why| SigningFileError::Unusable { path: stamp_path, why })?;
        Ok(LinkSigning { key, start, accepts_unsigned: false })
    }

    fn unusable(&self, why: std::io::Error) -> SigningFileError {
        SigningFileError::Unusable { path: self.path.clone(), why }
    }
}

fn key_from_hex(text: &str) -> Option<SigningKey> {
    if text.len() != 64 || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    let mut bytes = [0; 32];
    for (i, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(text.get(2 * i..2 * i + 2)?, 16).ok()?;
    }
    Some(SigningKey::new(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_private_and_stamps_never_decrease() {
        let folder = tempfile::tempdir().unwrap();
        let file = SigningFile::new(&folder.path().join("mavlink.key"));
        let key = SigningKey::new(core::array::from_fn(|i| 200 + i as u8));
        file.create(&key).unwrap();
        assert!(file.create(&key).is_err(), "a key is not overwritten");
        let at = SigningTime::from_units;
        let first = file.open_at(at(5_000)).unwrap();
        assert_eq!((first.key, first.start), (key, at(5_000)));
        assert_eq!(file.open_at(at(9_000)).unwrap().start, at(9_000));
        let fallen_back = file.open_at(at(10)).unwrap().start;
        assert_eq!(fallen_back, at(9_000).plus_us(RESERVE_US));
        assert!(file.open_at(at(11)).unwrap().start > fallen_back);
    }

    #[test]
    fn refuses_an_invalid_or_readable_key() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        let check = |text: &str, mode, expected: &str| {
            fs::write(&path, text).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            let error = SigningFile::new(&path).open().unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check("secret", 0o600, "no key of 64");
        check(&"+f".repeat(32), 0o644, "read by others");
        fs::remove_file(&path).unwrap();
        assert!(SigningFile::new(&path).open().unwrap_err().to_string().contains("key:"));
    }
}
