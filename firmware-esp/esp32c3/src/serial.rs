//! The autopilot's serial port: an interrupt empties the chip's 128 bytes into a larger buffer, so
//! that neither the radio's work nor a flash write of the other tasks loses bytes.

use core::sync::atomic::{AtomicU32, Ordering};

use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::pipe::Pipe;
use esp_hal::Blocking;
use esp_hal::uart::{Config, CtsConfig, HwFlowControl, RtsConfig, RxConfig, RxError, UartRx};

/// 22 ms at 921600 baud, 6.8 ms at 3000000. [bytes]
const BUFFER: usize = 2048;
/// The interrupt comes at half of the chip's 128 bytes, or after a pause of two characters: the
/// other half is 0.7 ms at 921600 baud. [bytes]
const THRESHOLD: u16 = 64;
/// The autopilot is asked to pause when so many of the 128 bytes are taken. [bytes]
const PAUSE_AT: u8 = 112;

/// Received bytes, for the bridge.
pub(crate) static RECEIVED: Pipe<CriticalSectionRawMutex, BUFFER> = Pipe::new();
static OVERRUNS: AtomicU32 = AtomicU32::new(0);

/// Returns how often the chip's buffer ran over; some bytes of up to 128 are lost each time. Wraps.
pub(crate) fn overruns() -> u32 {
    OVERRUNS.load(Ordering::Relaxed)
}

/// Returns the port's configuration; flow control needs RTS and CTS wired.
pub(crate) fn config(baud: u32, flow_control: bool) -> Config {
    let flow = if flow_control {
        HwFlowControl { cts: CtsConfig::Enabled, rts: RtsConfig::Enabled(PAUSE_AT) }
    } else {
        HwFlowControl { cts: CtsConfig::Disabled, rts: RtsConfig::Disabled }
    };
    Config::default()
        .with_baudrate(baud)
        .with_hw_flow_ctrl(flow)
        .with_rx(RxConfig::default().with_fifo_full_threshold(THRESHOLD).with_timeout(2))
}

/// Moves what comes into [`RECEIVED`], for ever. With flow control a full buffer pauses the
/// autopilot; without, the overrun is counted.
#[embassy_executor::task]
pub(crate) async fn receive(port: UartRx<'static, Blocking>) {
    let mut port = port.into_async();
    let mut bytes = [0; THRESHOLD as usize];
    loop {
        match port.read_async(&mut bytes).await {
            Ok(len) => RECEIVED.write_all(&bytes[..len]).await,
            Err(RxError::FifoOverflowed) => {
                OVERRUNS.store(overruns().wrapping_add(1), Ordering::Relaxed);
            }
            // Glitches and wrong stop bits: the packet they hit fails its checksum, and is counted.
            Err(_) => {}
        }
    }
}
