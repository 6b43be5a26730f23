//! `vizflyt bridge firmware`: signs firmware for a bridge and uploads it over the network.

use std::fs;
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand, ValueEnum};
use ed25519_dalek::{Signer, SigningKey};
use sha2::{Digest, Sha256};
use vizflyt_bridge::settings::{Key, key_from_hex, key_to_hex};
use vizflyt_bridge::update::{Header, MAGIC, Target};
use vizflyt_process::print_line;
use vizflyt_trust::KeysFolder;

/// Sign firmware for a bridge, and upload it over the network
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  export VIZFLYT_FIRMWARE_KEY=$(vizflyt bridge firmware key)      once; bridges built with this key trust it
  VIZFLYT_FIRMWARE_BUILD=7 firmware-esp/esp32c3/build
  vizflyt bridge firmware sign firmware-esp/esp32c3/target/image/bridge-esp32c3-update.bin \\
      --chip esp32c3 --build 7 -o bridge-7.signed
  vizflyt bridge firmware send bridge-7.signed --bridge drone-3.local")]
pub(crate) struct FirmwareArgs {
    #[command(subcommand)]
    command: FirmwareCommand,
}

#[derive(Subcommand, Clone, Debug)]
enum FirmwareCommand {
    /// Print the public key for the build; make the key pair if there is none
    Key(KeyArgs),
    /// Sign a firmware image
    Sign(SignArgs),
    /// Upload signed firmware to a bridge, which verifies it and starts it on trial
    Send(SendArgs),
}

#[derive(Args, Clone, Debug)]
struct KeyArgs {
    /// Folder of keys; the firmware key is `firmware.key` in it
    ///
    /// Keep it secret: the key can install firmware on all bridges that trust it.
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

#[derive(Args, Clone, Debug)]
struct SignArgs {
    /// Firmware image without bootloader: bridge-esp32c3-update.bin
    #[arg(value_name = "IMAGE")]
    image: PathBuf,
    /// Target chip
    #[arg(long)]
    chip: ChipName,
    /// Build number of the image; bridges reject older builds than they run
    #[arg(long, value_name = "N")]
    build: u32,
    /// Signed output file
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    key: KeyArgs,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ChipName {
    /// ESP32-C3
    Esp32c3,
    /// This computer, for a test with `vizflyt bridge emulate --firmware-key`
    Host,
}

#[derive(Args, Clone, Debug)]
struct SendArgs {
    /// Signed firmware, written by `sign`
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Address of the bridge, or ADDRESS:PORT of its status page
    #[arg(long, value_name = "ADDRESS", default_value = "192.168.4.1")]
    bridge: String,
}

const KEY_FILE: &str = "firmware.key";
/// Timeout for the bridge's reply; erasing its flash takes less.
const PATIENCE: Duration = Duration::from_secs(15);

/// Runs `vizflyt bridge firmware`.
pub(crate) fn run(args: &FirmwareArgs) -> Result<()> {
    match &args.command {
        FirmwareCommand::Key(args) => {
            let key = match read_key(args)? {
                Some(key) => key,
                None => make_key(args)?,
            };
            print_line(key_to_hex(&key.verifying_key().to_bytes()));
            Ok(())
        }
        FirmwareCommand::Sign(args) => sign(args),
        FirmwareCommand::Send(args) => send(args),
    }
}

fn read_key(args: &KeyArgs) -> Result<Option<SigningKey>> {
    let folder = KeysFolder::open(args.keys.as_deref())?;
    let Some(text) = folder.read_secret(KEY_FILE)? else { return Ok(None) };
    let Ok(secret) = key_from_hex(text.trim()) else {
        bail!("{}: not 64 hexadecimal digits", folder.file(KEY_FILE).display());
    };
    Ok(Some(SigningKey::from_bytes(&secret)))
}

fn make_key(args: &KeyArgs) -> Result<SigningKey> {
    let mut secret: Key = [0; 32];
    fs::File::open("/dev/urandom")
        .and_then(|mut file| file.read_exact(&mut secret))
        .context("no random numbers from /dev/urandom")?;
    let folder = KeysFolder::open(args.keys.as_deref())?;
    folder.write(KEY_FILE, &format!("{}\n", key_to_hex(&secret)))?;
    Ok(SigningKey::from_bytes(&secret))
}

fn sign(args: &SignArgs) -> Result<()> {
    let key = read_key(&args.key)?.context(
        "no firmware key in the folder of keys; `vizflyt bridge firmware key` makes one, and bridges \
         built with what it prints trust it",
    )?;
    let image = fs::read(&args.image)
        .with_context(|| format!("cannot read {}; build it first", args.image.display()))?;
    if image.starts_with(&MAGIC) {
        bail!("{} is signed already", args.image.display());
    }
    let target = match args.chip {
        ChipName::Esp32c3 => Target::Esp32C3,
        ChipName::Host => Target::Host,
    };
    let signed = signed(&key, target, args.build, &image)?;
    fs::write(&args.output, &signed)
        .with_context(|| format!("cannot write {}", args.output.display()))?;
    print_line(format!("{}: build {}, {} bytes", args.output.display(), args.build, signed.len()));
    Ok(())
}

/// Returns the signed firmware file.
fn signed(key: &SigningKey, target: Target, build: u32, image: &[u8]) -> Result<Vec<u8>> {
    let len = u32::try_from(image.len()).context("an image of more than 4 GB")?;
    let header = Header { target: target as u8, build, len, hash: Sha256::digest(image).into() };
    let head = header.sign(|message| key.sign(message).to_bytes());
    Ok([&head[..], image].concat())
}

fn send(args: &SendArgs) -> Result<()> {
    let firmware =
        fs::read(&args.file).with_context(|| format!("cannot read {}", args.file.display()))?;
    if !firmware.starts_with(&MAGIC) {
        bail!("{} is not signed; `vizflyt bridge firmware sign` does that", args.file.display());
    }
    let address = match &args.bridge {
        address if address.contains(':') => address.clone(),
        address => format!("{address}:80"),
    };
    print_line(format!("{}: {}", args.bridge, bring(&address, &firmware, &args.file)?));
    Ok(())
}

/// Uploads firmware to the page of a bridge; returns its reply.
fn bring(address: &str, firmware: &[u8], name: &Path) -> Result<String> {
    let resolved = address
        .to_socket_addrs()
        .with_context(|| format!("bridge: {address} has no address"))?
        .next()
        .with_context(|| format!("bridge: {address} has no address"))?;
    let mut stream = TcpStream::connect_timeout(&resolved, PATIENCE).with_context(|| {
        format!("bridge: no reply from {address}; check that its page is enabled")
    })?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let head = format!("POST /update HTTP/1.0\r\nContent-Length: {}\r\n\r\n", firmware.len());
    // A bridge that rejects the firmware replies before the last byte: its reply counts, not the
    // broken connection.
    let sent = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(firmware));
    let mut answer = Vec::new();
    let received = stream.read_to_end(&mut answer);
    let answer = String::from_utf8_lossy(&answer).into_owned();
    let words = answer.split_once("\r\n\r\n").map_or("", |(_, body)| body.trim());
    let status = answer.split_whitespace().nth(1).unwrap_or_default();
    match status {
        "200" => Ok(words.to_owned()),
        "" => {
            sent.and(received.map(|_| ())).with_context(|| {
                format!("bridge: the connection broke while {} was on its way", name.display())
            })?;
            bail!("bridge: no reply after the upload; check the bridge's page")
        }
        "404" => {
            bail!(
                "bridge: its firmware does not support updates over the network; flash it by wire"
            )
        }
        _ => bail!("bridge: firmware was rejected: {words}"),
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::thread;

    use vizflyt_bridge::update::{Fault, HEADER};

    use super::*;

    fn keys() -> (tempfile::TempDir, KeyArgs) {
        let folder = tempfile::tempdir().unwrap();
        let keys = Some(folder.path().join("keys"));
        (folder, KeyArgs { keys })
    }

    #[test]
    fn accepts_signed_firmware_with_the_printed_key() {
        let (folder, key) = keys();
        let made = make_key(&key).unwrap();
        assert_eq!(read_key(&key).unwrap().unwrap().to_bytes(), made.to_bytes());
        let (image, output) = (folder.path().join("image.bin"), folder.path().join("signed"));
        fs::write(&image, b"\xe9 a program").unwrap();
        let args =
            SignArgs { image, chip: ChipName::Esp32c3, build: 7, output: output.clone(), key };
        sign(&args).unwrap();
        let bytes = fs::read(&output).unwrap();
        let head: &[u8; HEADER] = bytes.first_chunk().unwrap();
        let public = made.verifying_key().to_bytes();
        let header = Header::open(head, &public).unwrap();
        assert_eq!((header.target, header.build, header.len), (1, 7, 11));
        assert_eq!(Header::open(head, &[7; 32]), Err(Fault::Signature));
        let again = SignArgs { image: output, ..args };
        assert!(sign(&again).unwrap_err().to_string().contains("is signed already"));
    }

    #[test]
    fn shows_the_reply_of_the_bridge() {
        let answers =
            ["200 OK\r\n\r\nverified", "409 Conflict\r\n\r\nthe vehicle is armed", "404 X"];
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let serve = thread::spawn(move || {
            for answer in answers {
                let (mut stream, _) = listener.accept().unwrap();
                let mut got = Vec::new();
                let mut bytes = [0; 4096];
                while !got.ends_with(b"the end") {
                    let len = stream.read(&mut bytes).unwrap();
                    got.extend_from_slice(&bytes[..len]);
                }
                assert!(got.starts_with(b"POST /update HTTP/1.0\r\n"));
                write!(stream, "HTTP/1.0 {answer}\r\n").unwrap();
            }
        });
        let bring = || bring(&address, b"VZU1 and so on to the end", Path::new("a"));
        assert_eq!(bring().unwrap(), "verified");
        assert!(bring().unwrap_err().to_string().contains("the vehicle is armed"));
        assert!(bring().unwrap_err().to_string().contains("by wire"));
        serve.join().unwrap();
    }
}
