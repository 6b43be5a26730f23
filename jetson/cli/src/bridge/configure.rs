//! `vizflyt bridge configure` (claims a bridge, shows and changes its settings) and `vizflyt bridge
//! stats`.

use std::io::Read;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde_json::{Map, Value};
use vizflyt_bridge::access::{Op, Status};
use vizflyt_bridge::settings::{Key, NUMBERS, TEXTS, key_from_hex, key_to_hex};
use vizflyt_bridge::stats::REPORT;
use vizflyt_process::print_line;
use vizflyt_trust::KeysFolder;

use super::ask::BridgeClient;

/// Show and change the settings of a bridge
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  vizflyt bridge configure --claim                                  once for a new bridge
  vizflyt bridge configure                                          show all settings
  vizflyt bridge configure WIFI_STATION=1 wifi.ssid=lab wifi.password=... --restart
  vizflyt bridge configure --bridge vizflyt.local LOSS_MS=800
  vizflyt bridge configure vehicle.key=@/etc/vizflyt/mavlink.key    sign its LAND commands; the key is read from a file
  vizflyt bridge configure wifi.country=DE UART_TX_PIN=21 UART_RX_PIN=20 --restart
  vizflyt bridge configure TRANSPARENT=1 --restart                  pass all bytes unparsed; the bridge sends no LAND

Changes are saved at once. The bridge rejects changes while the vehicle is armed.")]
pub(crate) struct ConfigureArgs {
    /// Settings to change; without any, all settings are shown
    #[arg(value_name = "NAME=VALUE")]
    changes: Vec<String>,
    /// Address of the bridge: ADDRESS or ADDRESS:PORT
    #[arg(long, value_name = "ADDRESS", default_value_t = super::emulate::DEFAULT_BRIDGE.to_string())]
    bridge: String,
    /// Set the key of a new bridge, and make the key if there is none yet
    ///
    /// Do this when no other computer is in the bridge's network.
    #[arg(long)]
    claim: bool,
    /// Reset all settings except the key to their defaults, before the changes
    #[arg(long)]
    reset: bool,
    /// Restart the bridge afterwards
    ///
    /// Speed, ports and Wi-Fi settings take effect only after a restart.
    #[arg(long)]
    restart: bool,
    /// Folder of keys; the bridge's key is `bridge.key` in it
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

/// Show the counters of a bridge: packets passed, packets lost, and why
#[derive(Args, Clone, Debug)]
pub(crate) struct StatsArgs {
    /// Address of the bridge: ADDRESS or ADDRESS:PORT
    #[arg(value_name = "ADDRESS", default_value_t = super::emulate::DEFAULT_BRIDGE.to_string())]
    bridge: String,
    /// Print the counters as JSON
    #[arg(long)]
    json: bool,
    /// Print the changes every second
    #[arg(long, conflicts_with = "json")]
    watch: bool,
}

const KEY_FILE: &str = "bridge.key";

/// Runs `vizflyt bridge configure`.
pub(crate) fn configure(args: &ConfigureArgs) -> Result<()> {
    let mut client = BridgeClient::open(&args.bridge)?;
    if args.claim {
        claim(&mut client, args)?;
    }
    let changes = !args.changes.is_empty() || args.reset || args.restart;
    if changes {
        let key = read_key(args)?.with_context(
            || "bridge: no key in the folder of keys; `vizflyt bridge configure --claim` makes one",
        )?;
        let mut tell_it = |op: Op, body: &str| change(&mut client, op, body, &key);
        if args.reset {
            tell_it(Op::Reset, "")?;
        }
        for setting in &args.changes {
            tell_it(Op::Set, &with_file(setting)?)?;
        }
        tell_it(Op::Save, "")?;
        if args.restart {
            tell_it(Op::Restart, "")?;
            print_line("saved; the bridge restarts");
            return Ok(());
        }
        print_line("saved");
    }
    if !args.claim {
        show(&mut client)?;
    }
    Ok(())
}

/// Replaces `@FILE` of a key by the file's content, so that keys stay out of the shell's history.
fn with_file(setting: &str) -> Result<String> {
    let file = setting.split_once("=@").filter(|(name, _)| name.ends_with("key"));
    let Some((name, path)) = file else { return Ok(setting.to_owned()) };
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {path}"))?;
    Ok(format!("{name}={}", text.trim()))
}

fn claim(client: &mut BridgeClient, args: &ConfigureArgs) -> Result<()> {
    let key = if let Some(key) = read_key(args)? {
        key
    } else {
        let mut key: Key = [0; 32];
        std::fs::File::open("/dev/urandom")
            .and_then(|mut file| file.read_exact(&mut key))
            .context("bridge: no random numbers from /dev/urandom")?;
        let folder = KeysFolder::open(args.keys.as_deref())?;
        folder.write(KEY_FILE, &format!("{}\n", key_to_hex(&key)))?;
        key
    };
    let (status, _) = client.ask(Op::Claim, &key, None)?;
    if status != Status::Done {
        bail!("bridge: not claimed: {}", status.message());
    }
    let path = KeysFolder::open(args.keys.as_deref())?.file(KEY_FILE);
    print_line(format!("claimed; its key is in {}", path.display()));
    Ok(())
}

fn read_key(args: &ConfigureArgs) -> Result<Option<Key>> {
    let folder = KeysFolder::open(args.keys.as_deref())?;
    let Some(text) = folder.read_secret(KEY_FILE)? else { return Ok(None) };
    let key = key_from_hex(text.trim()).map_err(|_| {
        anyhow::anyhow!(
            "{}: not 64 hexadecimal digits; copy the file again, or reset the bridge at its button and claim it",
            folder.file(KEY_FILE).display()
        )
    })?;
    Ok(Some(key))
}

fn change(client: &mut BridgeClient, op: Op, body: &str, key: &Key) -> Result<()> {
    match client.ask(op, body.as_bytes(), Some(key))? {
        (Status::Done, _) => Ok(()),
        (status, _) => {
            // Print only the name: a password must not end up in a terminal log.
            let name = body.split('=').next().unwrap_or_default();
            bail!("bridge: {op:?} {name} was rejected: {}", status.message())
        }
    }
}

fn show(client: &mut BridgeClient) -> Result<()> {
    let claimed = if client.claimed { "" } else { "; it has no key yet: --claim" };
    print_line(format!("bridge {}{claimed}", client.version));
    if client.transparent {
        print_line("transparent: bytes pass unparsed; no priorities, no LAND, armed or not");
    }
    let names = NUMBERS.iter().map(|number| number.name);
    for name in names.chain(TEXTS.iter().map(|&(name, _)| name)) {
        // Older firmware may not support this setting.
        if let (Status::Done, value) = client.ask(Op::Read, name.as_bytes(), None)? {
            print_line(format!("{name:18} {}", String::from_utf8_lossy(&value)));
        }
    }
    Ok(())
}

/// Runs `vizflyt bridge stats`.
pub(crate) fn stats(args: &StatsArgs) -> Result<()> {
    let mut client = BridgeClient::open(&args.bridge)?;
    let mut before: Option<Vec<u32>> = None;
    loop {
        let (_, body) = client.ask(Op::Stats, b"", None)?;
        let values: Vec<u32> = body
            .chunks_exact(4)
            .map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
            .collect();
        let named = || REPORT.iter().copied().zip(&values);
        if args.json {
            let map: Map<String, Value> =
                named().map(|(name, &value)| (name.to_owned(), value.into())).collect();
            print_line(Value::Object(map));
        } else if let Some(before) = &before {
            let changed: Vec<String> = named()
                .zip(before)
                .filter(|((_, value), before)| value != before)
                .map(|((name, value), before)| format!("{name} +{}", value.wrapping_sub(*before)))
                .collect();
            print_line(changed.join("  "));
        } else {
            for (name, value) in named() {
                print_line(format!("{name:24} {value}"));
            }
        }
        if !args.watch {
            return Ok(());
        }
        before = Some(values);
        std::thread::sleep(Duration::from_secs(1));
    }
}
