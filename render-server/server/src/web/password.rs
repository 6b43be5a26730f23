//! The instructor's password: set by `vizflyt password`, checked by `POST /api/login`.
//!
//! The file holds only its Argon2id hash and is read at each login, so that a new password takes effect at once (and
//! ends every session). A check takes about 20 ms and 19 MiB by design. One is checked at a time, few wait, and each
//! address has ten attempts, then one every three seconds.

use argon2::password_hash::phc::PasswordHash;
use argon2::{Argon2, Params, PasswordHasher};
use ring::rand::{SecureRandom, SystemRandom};
use serde::{Deserialize, Serialize};
use vizflyt_trust::{KeyError, KeysFolder};

/// Name of the password's file in the keys folder.
pub(super) const FILE: &str = "page-login.toml";

/// Contents of `page-login.toml`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LoginFile {
    /// Hash in PHC string format: `$argon2id$v=19$m=19456,t=2,p=1$...`.
    password: String,
}

/// Sets the instructor's password of the server that uses `folder`; takes effect at once on a running server.
///
/// # Errors
/// If the password is too short or too long, or the folder cannot be written.
pub fn set_password(folder: &KeysFolder, password: &str) -> Result<(), KeyError> {
    let damaged = |what: String| KeyError::Damaged { path: folder.file(FILE), what };
    let length = password.chars().count();
    if length < MIN_LETTERS || password.len() > MAX_BYTES {
        return Err(damaged(format!(
            "a password has {MIN_LETTERS} letters at least and {MAX_BYTES} bytes at most, not \
             {length} letters; take four words that nobody else puts together"
        )));
    }
    let mut salt = [0; 16];
    SystemRandom::new()
        .fill(&mut salt)
        .map_err(|_| damaged("the system gives no random numbers".to_owned()))?;
    let hash = Argon2::default()
        .hash_password_with_salt(password.as_bytes(), &salt)
        .map_err(|error| damaged(error.to_string()))?;
    let file = LoginFile { password: hash.to_string() };
    let text = toml::to_string(&file).map_err(|error| damaged(error.to_string()))?;
    folder.write(FILE, &(HEAD.to_owned() + &text))
}

/// Returns the hash of the password; `None` if none is set.
pub(super) fn read(folder: &KeysFolder) -> Result<Option<PasswordHash>, KeyError> {
    let damaged = |what: String| KeyError::Damaged {
        path: folder.file(FILE),
        what: format!("{what}; set a new password: vizflyt password"),
    };
    let Some(text) = folder.read_secret(FILE)? else { return Ok(None) };
    let file: LoginFile = toml::from_str(&text).map_err(|error| damaged(error.to_string()))?;
    let hash = PasswordHash::new(&file.password)
        .map_err(|error| damaged(format!("password is not an Argon2 hash: {error}")))?;
    let params = Params::try_from(&hash).map_err(|error| damaged(error.to_string()))?;
    if params.m_cost() > MAX_KIB || params.t_cost() > MAX_PASSES {
        return Err(damaged(format!("a hash of {} KiB is refused", params.m_cost())));
    }
    Ok(Some(hash))
}

const HEAD: &str = "\
# The instructor's password for the server's page, hashed. Set another with `vizflyt password`; remove this file
# to disable login by password.
";
/// Minimum length. NIST SP 800-63B-4, section 3.1.1.2, requires 15 for a password as the only protection; a lab also
/// has its own network, and attempts are limited.
const MIN_LETTERS: usize = 10;
/// Maximum length [bytes].
pub(super) const MAX_BYTES: usize = 256;
/// Maximum memory of a check: 256 MiB; more indicates a typing error [KiB].
const MAX_KIB: u32 = 256 << 10;
const MAX_PASSES: u32 = 32;

#[cfg(test)]
mod tests {
    use argon2::PasswordVerifier;

    use super::*;

    #[test]
    fn a_password_is_kept_as_its_hash_and_checked_by_it() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        assert!(read(&folder).unwrap().is_none());
        for wrong in ["", "short", &"x".repeat(MAX_BYTES + 1)] {
            let error = set_password(&folder, wrong).unwrap_err().to_string();
            assert!(error.contains("10 letters at least"), "{error}");
        }
        set_password(&folder, "correct horse battery").unwrap();
        let text = folder.read_secret(FILE).unwrap().unwrap();
        assert!(text.contains("$argon2id$v=19$m=19456,t=2,p=1$") && !text.contains("horse"));
        let hash = read(&folder).unwrap().unwrap();
        let fits =
            |password: &str| Argon2::default().verify_password(password.as_bytes(), &hash).is_ok();
        assert!(fits("correct horse battery") && !fits("correct horse batterY") && !fits(""));
        // The salt differs each time.
        set_password(&folder, "correct horse battery").unwrap();
        assert_ne!(folder.read_secret(FILE).unwrap().unwrap(), text);
    }

    #[test]
    fn a_damaged_file_is_an_error_and_rejects_all_passwords() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        for (text, expected) in [
            ("", "missing field"),
            ("password = \"open\"", "not an Argon2 hash"),
            ("password = \"x\"\nuser = 1", "unknown field"),
            (
                "password = \"$argon2id$v=19$m=4194304,t=2,p=1$c2FsdHNhbHRzYWx0$aGFzaGhhc2hoYXNoaGFzaA\"",
                "4194304 KiB is refused",
            ),
        ] {
            folder.write(FILE, text).unwrap();
            let error = read(&folder).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
