//! Automatic restarts: after a panic, and by the watchdog if forwarding hangs. A bridge on a vehicle is out of reach
//! for a manual restart.

use core::sync::atomic::Ordering;

use esp_hal::peripherals::TIMG1;
use esp_hal::ram;
use esp_hal::rtc_cntl::SocResetReason;
use esp_hal::time::Duration;
use esp_hal::timer::timg::{MwdtStage, Wdt};
use portable_atomic::AtomicU32;
use vizflyt_bridge::stats::RestartCause;

/// Timeout of the watchdog. Forwarding resets it at least once a second; the longest interruption, erasing a sector of
/// flash, takes well under a second.
const PATIENCE: Duration = Duration::from_secs(5);
/// Value of [`PANICKED`] after a panic. Any other value is random content from power-on.
const MARK: u32 = 0x50_41_4E_43;

/// Persists over a reset, but not over a power loss.
#[ram(unstable(rtc_fast, persistent))]
static PANICKED: AtomicU32 = AtomicU32::new(0);

/// Watchdog. It runs from its creation on, so that a hanging start also restarts the chip. Only the forwarding task
/// resets it.
pub(crate) struct Watchdog(Wdt<TIMG1<'static>>);

impl Watchdog {
    /// Starts the watchdog.
    pub(crate) fn start(mut timer: Wdt<TIMG1<'static>>) -> Self {
        timer.enable();
        timer.set_timeout(MwdtStage::Stage0, PATIENCE);
        timer.feed();
        Self(timer)
    }

    /// Resets the timeout.
    pub(crate) fn feed(&mut self) {
        self.0.feed();
    }
}

/// Returns the cause of the chip's start. Call it once, at the start.
pub(crate) fn cause() -> RestartCause {
    use SocResetReason as Reason;
    let panicked = PANICKED.load(Ordering::Relaxed) == MARK;
    PANICKED.store(0, Ordering::Relaxed);
    match esp_hal::system::reset_reason() {
        Some(Reason::CoreSw | Reason::Cpu0Sw) if panicked => RestartCause::Panic,
        Some(Reason::CoreSw | Reason::Cpu0Sw | Reason::CoreUsbUart | Reason::CoreUsbJtag) => {
            RestartCause::Asked
        }
        Some(Reason::ChipPowerOn) => RestartCause::Power,
        Some(Reason::SysBrownOut | Reason::CorePwrGlitch) => RestartCause::Brownout,
        Some(
            Reason::CoreMwdt0
            | Reason::CoreMwdt1
            | Reason::Cpu0Mwdt0
            | Reason::Cpu0Mwdt1
            | Reason::CoreRtcWdt
            | Reason::Cpu0RtcWdt
            | Reason::SysRtcWdt
            | Reason::SysSuperWdt,
        ) => RestartCause::Watchdog,
        Some(_) | None => RestartCause::Unknown,
    }
}

/// Ends a panic, after its message was sent over USB.
#[unsafe(no_mangle)]
fn custom_halt() -> ! {
    PANICKED.store(MARK, Ordering::Relaxed);
    esp_hal::system::software_reset()
}
