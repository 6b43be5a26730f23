//! `vizflyt crazyflie`: a Crazyflie's own estimate, as our pose packets. Feature `crazyflie`.
//!
//! ```text
//! Loco, Lighthouse, flow deck -> the Crazyflie's estimator -> log block over its radio
//!                             -> this -> JSON pose packets over UDP -> server, driver `json`
//! ```
//! Beside the radio dongle, on whatever computer that is. The Crazyflie's world is z up, its body x
//! forward, y left, z up, as ours. A packet of its log holds at most 26 bytes: the compressed estimate
//! fits, millimetres and a quaternion in 32 bits (`stateEstimateZ`).

use std::net::{SocketAddr, UdpSocket};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use crazyflie_lib::crazyflie_link::LinkContext;
use crazyflie_lib::subsystems::log::{LogData, LogPeriod};
use crazyflie_lib::{Crazyflie, NoTocCache};
use tokio::time::timeout;
use vizflyt_process::print_line;

use self::estimate::pose_packet;

mod estimate;

/// Sends a Crazyflie's own estimate (Loco, Lighthouse, flow deck) to the server as poses
///
/// The server listens with `--pose json` (docs/guides/localization.md). Runs until the Crazyflie or
/// the radio is gone, or control-C.
#[derive(Args, Debug)]
#[command(after_help = "Example:
  vizflyt crazyflie radio://0/80/2M/E7E7E7E7E7 --to 192.168.1.20:51002 --object vizflyt")]
pub(crate) struct CrazyflieArgs {
    /// Its address on the radio, as the client of Bitcraze shows it
    uri: String,
    /// Where the server listens for pose packets
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:51002")]
    to: SocketAddr,
    /// What the server calls the vehicle
    #[arg(long, value_name = "NAME", default_value = "vizflyt")]
    object: String,
    /// Poses a second: 1000 / this is a multiple of 10 ms
    #[arg(long, value_name = "HZ", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=100))]
    rate: u64,
}

/// Sends until the end.
pub(crate) fn run(args: &CrazyflieArgs) -> Result<ExitCode> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(send(args))?;
    Ok(ExitCode::SUCCESS)
}

async fn send(args: &CrazyflieArgs) -> Result<()> {
    let any = if args.to.is_ipv6() { "[::]:0" } else { "0.0.0.0:0" };
    let socket = UdpSocket::bind(any).context("cannot open a socket for poses")?;
    let context = LinkContext::new();
    let connecting = Crazyflie::connect_from_uri(&context, &args.uri, NoTocCache);
    let crazyflie = timeout(CONNECT, connecting)
        .await
        .context("no answer for 20 s")
        .and_then(|connected| connected.context("the radio refuses"))
        .with_context(|| {
            format!(
                "no Crazyflie at {}: is the Crazyradio plugged in (and may you use it: Bitcraze's udev \
                 rules), is the vehicle on, is its address right, and is no other client connected?",
                args.uri
            )
        })?;
    let mut block = crazyflie.log.create_block().await.context("its log")?;
    for variable in VARIABLES {
        block.add_variable(variable).await.with_context(|| {
            format!(
                "its log has no {variable}; update the Crazyflie's firmware to 2021.01 or newer"
            )
        })?;
    }
    let period = LogPeriod::from_millis((1000 / args.rate).max(10)).context("its log's period")?;
    let stream = block.start(period).await.context("its log")?;
    print_line(format!("{} -> {} as '{}'", args.uri, args.to, args.object));
    let mut seq = 0_u64;
    loop {
        let data = match timeout(SILENCE, stream.next()).await {
            Ok(Ok(data)) => data,
            Ok(Err(error)) => bail!("the Crazyflie is gone after {seq} poses: {error}"),
            Err(_) => bail!("the Crazyflie has been silent for 2 s, after {seq} poses"),
        };
        seq += 1;
        // Lost like any datagram if nobody listens.
        let packet = pose_packet(&args.object, seq, data.timestamp, values(&data)?);
        let _ = socket.send_to(packet.to_string().as_bytes(), args.to);
    }
}

/// Returns what a record of the log holds.
fn values(data: &LogData) -> Result<[f64; 4]> {
    let mut values = [0.0; 4];
    for (value, name) in values.iter_mut().zip(VARIABLES) {
        let found = data.data.get(name).with_context(|| format!("a record has no {name}"))?;
        *value = found.to_f64_lossy();
    }
    Ok(values)
}

/// x, y, z \[mm\] and the quaternion.
const VARIABLES: [&str; 4] =
    ["stateEstimateZ.x", "stateEstimateZ.y", "stateEstimateZ.z", "stateEstimateZ.quat"];
/// Its tables come over the radio first.
const CONNECT: Duration = Duration::from_secs(20);
const SILENCE: Duration = Duration::from_secs(2);
