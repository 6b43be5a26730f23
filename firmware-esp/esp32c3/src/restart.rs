//! Starts that nobody asked for: after a panic, and when the watchdog finds that forwarding hangs. A
//! bridge on a vehicle has nobody near it who could press a button.

use core::sync::atomic::Ordering;

use esp_hal::peripherals::TIMG1;
use esp_hal::ram;
use esp_hal::rtc_cntl::SocResetReason;
use esp_hal::time::Duration;
use esp_hal::timer::timg::{MwdtStage, Wdt};
use portable_atomic::AtomicU32;
use vizflyt_bridge::stats::RestartCause;

/// Forwarding comes round once a second at least. Erasing a half of the flash, sector by sector, is what
/// takes longest between: well under a second each.
const PATIENCE: Duration = Duration::from_secs(5);
/// What [`PANICKED`] holds after a panic; any other value is what the memory held when power came on.
const MARK: u32 = 0x50_41_4E_43;

/// Lives through a reset, not through a loss of power.
#[ram(unstable(rtc_fast, persistent))]
static PANICKED: AtomicU32 = AtomicU32::new(0);

/// The watchdog. It bites from its making on, so that a start that hangs is one more start; only the
/// forwarding task feeds it.
pub(crate) struct Watchdog(Wdt<TIMG1<'static>>);

impl Watchdog {
    /// Starts it.
    pub(crate) fn start(mut timer: Wdt<TIMG1<'static>>) -> Self {
        timer.enable();
        timer.set_timeout(MwdtStage::Stage0, PATIENCE);
        timer.feed();
        Self(timer)
    }

    /// Keeps it from biting for another while.
    pub(crate) fn feed(&mut self) {
        self.0.feed();
    }
}

/// Returns why the chip has started; once, at the start.
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

/// What a panic ends in, after its message has gone out over USB.
#[unsafe(no_mangle)]
fn custom_halt() -> ! {
    PANICKED.store(MARK, Ordering::Relaxed);
    esp_hal::system::software_reset()
}
