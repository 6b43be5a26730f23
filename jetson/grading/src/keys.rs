//! Signing key of grades, and the hashes of plugin and program.

use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use ed25519_dalek::{SigningKey, VerifyingKey};
use sha2::{Digest, Sha256};
use vizflyt_trust::{KeysFolder, from_hex, hex};

use crate::door::Files;

/// File in the folder of keys with the secret key, as 64 hexadecimal digits.
const KEY_FILE: &str = "grading.key";
/// Returns the key that signs grades; the first grade makes it.
pub(crate) fn signing_key(keys: Option<&Path>) -> Result<SigningKey> {
    let folder = KeysFolder::open(keys)?;
    if let Some(key) = read_key(&folder)? {
        return Ok(key);
    }
    let mut secret = [0; 32];
    File::open("/dev/urandom")
        .and_then(|mut file| file.read_exact(&mut secret))
        .context("no random numbers from /dev/urandom")?;
    folder.write(KEY_FILE, &format!("{}\n", hex(&secret)))?;
    // If two processes made a key at the same time, both use the later one.
    read_key(&folder)?.context("the key that was just written is not there")
}

fn read_key(folder: &KeysFolder) -> Result<Option<SigningKey>> {
    let Some(text) = folder.read_secret(KEY_FILE)? else { return Ok(None) };
    let Some(secret) = from_hex::<32>(text.trim()) else {
        bail!("{}: not 64 hexadecimal digits", folder.file(KEY_FILE).display());
    };
    Ok(Some(SigningKey::from_bytes(&secret)))
}

/// Returns the key to verify grades with: the given one, in hexadecimal or in a file, or this
/// computer's own.
pub(crate) fn verifying_key(given: Option<&str>, keys: Option<&Path>) -> Result<VerifyingKey> {
    let Some(given) = given else {
        let own = read_key(&KeysFolder::open(keys)?)?;
        let own = own.context(
            "this computer has graded nothing yet; give the accepted signer with --key: the \
             key that `vizflyt grade key` prints on the computer that made the grade",
        )?;
        return Ok(own.verifying_key());
    };
    let text = if Path::new(given).is_file() {
        fs::read_to_string(given).with_context(|| format!("cannot read {given}"))?
    } else {
        given.to_owned()
    };
    // Accept upper case, as in a copied key.
    let bytes = from_hex::<32>(&text.trim().to_ascii_lowercase());
    let bytes = bytes.with_context(|| format!("--key {given}: not 64 hexadecimal digits"))?;
    let key = VerifyingKey::from_bytes(&bytes).ok();
    key.with_context(|| format!("--key {given}: not a valid public key"))
}

/// Returns the SHA-256 of this program's file.
pub(crate) fn program_sha256() -> Result<String> {
    let path = std::env::current_exe().context("cannot find this program's path")?;
    let mut hash = Sha256::new();
    update(&mut hash, &path)?;
    Ok(hex(&hash.finalize()))
}

/// Returns the SHA-256 over a plugin's files: names and contents, sorted by path.
pub(crate) fn files_sha256(files: &Files) -> String {
    let mut sorted: Vec<(&Path, &[u8])> =
        files.iter().map(|(path, content)| (Path::new(path), &content[..])).collect();
    sorted.sort();
    let mut hash = Sha256::new();
    for (path, content) in sorted {
        start(&mut hash, path, content.len() as u64);
        hash.update(content);
    }
    hex(&hash.finalize())
}

/// Returns the SHA-256 of a program that is not a student's, as if it were a plugin's only file.
pub(crate) fn program_file_sha256(path: &Path) -> Result<String> {
    let file = found(path);
    let len = fs::metadata(&file).with_context(|| format!("{}", file.display()))?.len();
    let mut hash = Sha256::new();
    start(&mut hash, file.file_name().map_or(path, Path::new), len);
    update(&mut hash, &file)?;
    Ok(hex(&hash.finalize()))
}

/// Adds a file's name and length; both come before the content, so that different folders give different bytes.
fn start(hash: &mut Sha256, name: &Path, len: u64) {
    let name = name.to_string_lossy();
    hash.update((name.len() as u64).to_le_bytes());
    hash.update(name.as_bytes());
    hash.update(len.to_le_bytes());
}

/// Returns the path of a program in PATH.
fn found(name: &Path) -> PathBuf {
    if name.exists() {
        return name.to_owned();
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut places = std::env::split_paths(&path).map(|folder| folder.join(name));
    places.find(|place| place.is_file()).unwrap_or_else(|| name.to_owned())
}

fn update(hash: &mut Sha256, path: &Path) -> Result<()> {
    let mut file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    std::io::copy(&mut file, hash).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::door::Door;

    #[test]
    fn makes_a_secret_key_once() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o700)).unwrap();
        let keys = Some(folder.path());
        assert!(verifying_key(None, keys).unwrap_err().to_string().contains("--key"));
        let key = signing_key(keys).unwrap();
        assert_eq!(signing_key(keys).unwrap().to_bytes(), key.to_bytes());
        let mode = folder.path().join(KEY_FILE).metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o077, 0);
        let public = key.verifying_key();
        assert_eq!(verifying_key(None, keys).unwrap(), public);
        assert_eq!(verifying_key(Some(&hex(&public.to_bytes())), None).unwrap(), public);
        for wrong in ["", "12", &"zz".repeat(32)] {
            assert!(verifying_key(Some(wrong), None).is_err(), "{wrong}");
        }
    }

    #[test]
    fn hashes_the_plugins_files_without_build_output() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        write("plugin.py", "import vizflyt");
        write("lib/steer.py", "x = 1");
        let out = folder.path().join("out");
        let read = || Door::open(folder.path()).unwrap().files(std::slice::from_ref(&out)).unwrap();
        let hash = || files_sha256(&read());
        let first = hash();
        write("__pycache__/plugin.pyc", "1");
        write(".venv/lib/numpy.py", "2");
        write("target/release/plugin", "3");
        write("out/flights/day-1.json", "4");
        assert_eq!(hash(), first);
        write("lib/steer.py", "x = 2");
        let second = hash();
        assert_ne!(second, first);
        // The same bytes under another name are another plugin.
        fs::rename(folder.path().join("lib"), folder.path().join("lib2")).unwrap();
        assert_ne!(hash(), second);
        let script = folder.path().join("plugin.py");
        assert_ne!(program_file_sha256(&script).unwrap(), first);
        let only = Files::from([("plugin.py".to_owned(), fs::read(&script).unwrap())]);
        assert_eq!(program_file_sha256(&script).unwrap(), files_sha256(&only));
        assert!(program_file_sha256(&folder.path().join("gone.py")).is_err());
    }
}
