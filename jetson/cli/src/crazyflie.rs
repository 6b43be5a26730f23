//! `vizflyt crazyflie`: sends a Crazyflie's own estimate as pose packets. Feature `crazyflie`.
//!
//! ```text
//! Loco, Lighthouse, flow deck -> the Crazyflie's estimator -> log block over its radio
//!                             -> this -> JSON pose packets over UDP -> server, driver `json`
//! ```
//! Runs on any computer with the radio dongle. The Crazyflie's frames are the same as ours: world z
//! up; body x forward, y left, z up. A packet of its log holds at most 26 bytes, enough for the
//! compressed estimate (`stateEstimateZ`): millimetres, and a quaternion in 32 bits.

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

/// Send a Crazyflie's own estimate to the server as poses
///
/// Works with Loco, Lighthouse and flow deck. The server listens with `--pose json`
/// (docs/guides/localization.md). Runs until the Crazyflie or the radio is gone, or until Ctrl-C.
#[derive(Args, Debug)]
#[command(after_help = "Example:
  vizflyt crazyflie radio://0/80/2M/E7E7E7E7E7 --to 192.168.1.20:51002 --object vizflyt")]
pub(crate) struct CrazyflieArgs {
    /// Radio address of the Crazyflie, as Bitcraze's client shows it
    uri: String,
    /// Address at which the server listens for pose packets
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:51002")]
    to: SocketAddr,
    /// Name of the vehicle on the server
    #[arg(long, value_name = "NAME", default_value = "vizflyt")]
    object: String,
    /// Pose rate [Hz]; 1000 / rate must be a multiple of 10 ms
    #[arg(long, value_name = "HZ", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=100))]
    rate: u64,
}

/// Sends until an error occurs.
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
        .context("no reply for 20 s")
        .and_then(|connected| connected.context("the radio refused the connection"))
        .with_context(|| {
            format!(
                "no Crazyflie at {}: check that the Crazyradio is plugged in (and Bitcraze's udev rules \
                 are installed), the vehicle is on, its address is right, and no other client is connected",
                args.uri
            )
        })?;
    let mut block = crazyflie.log.create_block().await.context("log of the Crazyflie")?;
    for variable in VARIABLES {
        block.add_variable(variable).await.with_context(|| {
            format!(
                "the log has no {variable}; update the Crazyflie's firmware to 2021.01 or newer"
            )
        })?;
    }
    let period = LogPeriod::from_millis((1000 / args.rate).max(10)).context("period of the log")?;
    let stream = block.start(period).await.context("log of the Crazyflie")?;
    print_line(format!("{} -> {} as '{}'", args.uri, args.to, args.object));
    let mut seq = 0_u64;
    loop {
        let data = match timeout(SILENCE, stream.next()).await {
            Ok(Ok(data)) => data,
            Ok(Err(error)) => bail!("the Crazyflie is gone after {seq} poses: {error}"),
            Err(_) => bail!("the Crazyflie has been silent for 2 s, after {seq} poses"),
        };
        seq += 1;
        // Lost if no server listens, like any datagram.
        let packet = pose_packet(&args.object, seq, data.timestamp, values(&data)?);
        let _ = socket.send_to(packet.to_string().as_bytes(), args.to);
    }
}

/// Returns the values of a log record.
fn values(data: &LogData) -> Result<[f64; 4]> {
    let mut values = [0.0; 4];
    for (value, name) in values.iter_mut().zip(VARIABLES) {
        let found = data.data.get(name).with_context(|| format!("a record has no {name}"))?;
        *value = found.to_f64_lossy();
    }
    Ok(values)
}

/// Logged variables: x, y, z \[mm\] and the quaternion.
const VARIABLES: [&str; 4] =
    ["stateEstimateZ.x", "stateEstimateZ.y", "stateEstimateZ.z", "stateEstimateZ.quat"];
/// Timeout of the connection, which first transfers the Crazyflie's tables over the radio.
const CONNECT: Duration = Duration::from_secs(20);
const SILENCE: Duration = Duration::from_secs(2);
