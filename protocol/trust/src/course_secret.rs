//! Secret from which the courses of a grade follow, in addition to the seed.
//!
//! A seed number can be guessed: a plugin that observes noise at rest can try all likely numbers. With a secret, course,
//! noise and all other random values are keyed hashes of the seed, each with a separate label. One of them therefore
//! discloses nothing about another.

use core::fmt;
use std::path::Path;

use hmac::{Hmac, Mac};
use sha2::Sha256;

use crate::folder::{KeyError, KeysFolder};
use crate::hex::{from_hex, hex};
use crate::identity::secret;

/// 128 random bits, or [`CourseSecret::PUBLIC`].
#[derive(Clone, PartialEq, Eq)]
pub struct CourseSecret(Option<[u8; 16]>);

/// Use of a seed. Values of one purpose disclose nothing about those of another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Geometry, textures and moving objects of the course.
    Course,
    /// Random light and weather of `random:N`.
    Environments,
    /// Noise of IMU and motion capture, wind.
    Noise,
    /// Drift of positions if the course withholds the pose.
    Slip,
    /// Noise of sensors other than cameras.
    Sensors,
    /// Noise of cameras.
    Imaging,
    /// Drops, flakes and lost depth.
    Weather,
}

impl Purpose {
    /// All purposes.
    pub const ALL: [Self; 7] = [
        Self::Course,
        Self::Environments,
        Self::Noise,
        Self::Slip,
        Self::Sensors,
        Self::Imaging,
        Self::Weather,
    ];

    /// Label in the hash; a changed label changes the values of all existing secrets.
    fn label(self) -> &'static str {
        match self {
            Self::Course => "course",
            Self::Environments => "environments",
            Self::Noise => "noise",
            Self::Slip => "slip",
            Self::Sensors => "sensors",
            Self::Imaging => "imaging",
            Self::Weather => "weather",
        }
    }
}

impl CourseSecret {
    /// No secret: every purpose uses the seed itself, so that everybody can repeat a grade.
    pub const PUBLIC: Self = Self(None);

    /// Reads a secret of 32 hexadecimal digits; the file must be accessible only to its owner.
    ///
    /// # Errors
    /// If the file is missing, readable by others, or contains something else.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        let (folder, name) = place(path)?;
        let damaged = |what: &str| KeyError::Damaged { path: path.into(), what: what.to_owned() };
        let text = folder.read_secret(name)?.ok_or_else(|| damaged("there is no such file"))?;
        let bytes = from_hex(text.trim());
        bytes.map(|bytes| Self(Some(bytes))).ok_or_else(|| damaged("not 32 hexadecimal digits"))
    }

    /// Reads a secret, as [`Self::read`]; creates the file with 128 random bits if it does not exist.
    ///
    /// # Errors
    /// As [`Self::read`], or if the file cannot be created.
    pub fn read_or_create(path: &Path) -> Result<Self, KeyError> {
        let (folder, name) = place(path)?;
        if !path.try_exists().unwrap_or(true) {
            let damaged = |what| KeyError::Damaged { path: path.into(), what };
            // False if another process has just created it: both use that file.
            folder.create(name, &format!("{}\n", secret().map_err(damaged)?))?;
        }
        Self::read(path)
    }

    /// Returns the number for a purpose: the seed itself without a secret, otherwise the first 64 bits of
    /// HMAC-SHA256(secret, label, 0, seed).
    pub fn seed(&self, purpose: Purpose, seed: u64) -> u64 {
        let bytes = self.keyed(&[purpose.label().as_bytes(), &[0], &seed.to_le_bytes()]);
        bytes.map_or(seed, u64::from_le_bytes)
    }

    /// Returns a name of the secret that does not disclose it, in hexadecimal; `None` without a secret.
    pub fn name(&self) -> Option<String> {
        self.keyed(&[b"name of the courses"]).map(|bytes: [u8; 16]| hex(&bytes))
    }

    /// Returns the first `N` bytes of HMAC-SHA256 over the parts; `None` without a secret.
    fn keyed<const N: usize>(&self, parts: &[&[u8]]) -> Option<[u8; N]> {
        let mut mac = Hmac::<Sha256>::new_from_slice(&self.0?).ok()?;
        for part in parts {
            mac.update(part);
        }
        mac.finalize().into_bytes().first_chunk().copied()
    }
}

impl fmt::Debug for CourseSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "CourseSecret(..)" } else { "CourseSecret::PUBLIC" })
    }
}

/// Returns folder and name of a file. Other users may enter the folder; the file's own mode protects it.
fn place(path: &Path) -> Result<(KeysFolder, &str), KeyError> {
    let name = path.file_name().and_then(|name| name.to_str());
    let name = name.ok_or_else(|| KeyError::Damaged {
        path: path.into(),
        what: "not the path of a file".to_owned(),
    })?;
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    Ok((KeysFolder::shared(parent.unwrap_or(Path::new("."))), name))
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn all(secret: &CourseSecret, seed: u64) -> Vec<u64> {
        Purpose::ALL.iter().map(|&purpose| secret.seed(purpose, seed)).collect()
    }

    #[test]
    fn without_a_secret_every_purpose_uses_the_seed() {
        assert_eq!(all(&CourseSecret::PUBLIC, 7), [7; 7]);
        assert_eq!(CourseSecret::PUBLIC.name(), None);
    }

    #[test]
    fn matches_an_independent_hmac() {
        // hmac.new(bytes(range(16)), b"course\0" + (1).to_bytes(8, "little"), "sha256").digest()[:8]
        let secret = CourseSecret(Some(core::array::from_fn(|index| index as u8)));
        assert_eq!(secret.seed(Purpose::Course, 1), 13042778351372514697);
        assert_eq!(format!("{secret:?}"), "CourseSecret(..)");
    }

    #[test]
    fn every_bit_of_seed_and_secret_changes_every_value() {
        let secret = [0x5a; 16];
        let (base, name) = (all(&CourseSecret(Some(secret)), 1), CourseSecret(Some(secret)).name());
        let mut seen: HashSet<u64> = base.iter().copied().collect();
        assert_eq!(seen.len(), Purpose::ALL.len());
        let mut distance = 0;
        let mut check = |values: Vec<u64>| {
            for (value, base) in values.into_iter().zip(&base) {
                assert!(seen.insert(value));
                distance += (value ^ base).count_ones();
            }
        };
        (0..64).for_each(|bit| check(all(&CourseSecret(Some(secret)), 1 ^ 1 << bit)));
        for bit in 0..128 {
            let other = CourseSecret(Some((u128::from_le_bytes(secret) ^ 1 << bit).to_le_bytes()));
            assert_ne!(other.name(), name);
            check(all(&other, 1));
        }
        // Half of the bits change: 32 of 64, with a standard deviation of 4 / sqrt(values).
        let mean = f64::from(distance) / (192.0 * Purpose::ALL.len() as f64);
        assert!((mean - 32.0).abs() < 5.0 * 4.0 / (192.0 * 7.0_f64).sqrt(), "{mean}");
    }

    #[test]
    fn creates_a_private_file_once() {
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let path = folder.path().join("course.secret");
        assert!(CourseSecret::read(&path).unwrap_err().to_string().contains("no such file"));
        let made = CourseSecret::read_or_create(&path).unwrap();
        assert_eq!(path.metadata().unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(CourseSecret::read_or_create(&path).unwrap(), made);
        assert_ne!(
            CourseSecret::read_or_create(&folder.path().join("other")).unwrap().name(),
            made.name()
        );
        fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
        assert!(CourseSecret::read(&path).is_err());
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        fs::write(&path, "4711\n").unwrap();
        let error = CourseSecret::read_or_create(&path).unwrap_err().to_string();
        assert!(error.contains("not 32 hexadecimal digits"), "{error}");
    }
}
