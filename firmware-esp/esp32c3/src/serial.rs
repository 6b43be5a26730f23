//! The autopilot's serial port: an interrupt empties the chip's FIFO of 128 bytes into a larger buffer, so that neither
//! the radio nor a flash write of other tasks loses bytes.

use core::sync::atomic::{AtomicU32, Ordering};

use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::pipe::Pipe;
use esp_hal::Blocking;
use esp_hal::uart::{Config, CtsConfig, HwFlowControl, RtsConfig, RxConfig, RxError, UartRx};

/// Size of the buffer: 22 ms at 921600 baud, 6.8 ms at 3000000 [bytes].
const BUFFER: usize = 2048;
/// FIFO level that raises the interrupt [bytes]; a pause of two characters also does. The remaining half lasts 0.7 ms
/// at 921600 baud.
const THRESHOLD: u16 = 64;
/// FIFO level at which RTS pauses the autopilot [bytes].
const PAUSE_AT: u8 = 112;

/// Received bytes, for the bridge.
pub(crate) static RECEIVED: Pipe<CriticalSectionRawMutex, BUFFER> = Pipe::new();
static OVERRUNS: AtomicU32 = AtomicU32::new(0);

/// Returns the number of FIFO overruns. Each loses at most 128 bytes. The counter wraps.
pub(crate) fn overruns() -> u32 {
    OVERRUNS.load(Ordering::Relaxed)
}

/// Returns the port's configuration. Flow control needs RTS and CTS wired.
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

/// Moves received bytes into [`RECEIVED`], forever. With flow control, a full buffer pauses the autopilot. Without it,
/// the overrun is counted.
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
            // Glitches and framing errors: the affected packet fails its checksum, which is counted.
            Err(_) => {}
        }
    }
}
