//! The radio as an Ethernet interface: received frames are read where the platform has them.

use core::ffi::CStr;
use core::task::Context;

use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use embassy_sync::waitqueue::AtomicWaker;
use embassy_time::{Duration, Instant, Timer};
use vizflyt_bridge::wifi;

use crate::platform;

/// An Ethernet frame without its checksum: 14 bytes of header, 1500 of payload.
pub(crate) const FRAME: usize = 1514;
static WAKER: AtomicWaker = AtomicWaker::new();

/// Looks again at the link, and whether frames have come or can be sent.
pub(crate) fn changed() {
    WAKER.wake();
}

/// What the network stack drives.
pub(crate) struct Radio {
    mac: [u8; 6],
    frame: [u8; FRAME],
}

impl Radio {
    pub(crate) const fn new() -> Self {
        Self { mac: [0; 6], frame: [0; FRAME] }
    }

    /// Takes the interface's address; before anything else.
    pub(crate) fn begin(&mut self, mac: [u8; 6]) {
        self.mac = mac;
    }
}

impl Driver for Radio {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sending<'a>;

    fn receive(&mut self, cx: &mut Context<'_>) -> Option<(Received, Sending<'_>)> {
        WAKER.register(cx.waker());
        if !platform::is_frame_waiting() || !platform::is_frame_ready() {
            return None;
        }
        Some((Received, Sending(&mut self.frame)))
    }

    fn transmit(&mut self, cx: &mut Context<'_>) -> Option<Sending<'_>> {
        WAKER.register(cx.waker());
        platform::is_frame_ready().then_some(Sending(&mut self.frame))
    }

    fn link_state(&mut self, cx: &mut Context<'_>) -> LinkState {
        WAKER.register(cx.waker());
        if platform::is_link_up() { LinkState::Up } else { LinkState::Down }
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = FRAME;
        capabilities.max_burst_size = Some(1);
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet(self.mac)
    }
}

/// The frame that has waited longest.
pub(crate) struct Received;

impl RxToken for Received {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, f: F) -> R {
        platform::with_frame(f)
    }
}

/// Room for one frame.
pub(crate) struct Sending<'a>(&'a mut [u8; FRAME]);

impl TxToken for Sending<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, f: F) -> R {
        let result = f(&mut self.0[..len]);
        platform::frame_out(&self.0[..len]);
        result
    }
}

/// The radio, for the bridge.
pub(crate) struct Control;

/// Longer than any network takes that will let us in.
const JOIN: Duration = Duration::from_secs(10);
/// How often the link is looked at while it is waited for.
const LOOK: Duration = Duration::from_millis(50);
/// The SDK joins again by itself after a short loss; only one of this length counts.
const GONE: Duration = Duration::from_secs(3);

/// Calls `f` with two texts as C has them, each ended by a zero. A name has 32 bytes at most, a
/// password 64.
fn with_texts(ssid: &str, password: &str, f: impl FnOnce(&CStr, &CStr) -> bool) -> bool {
    let (mut name, mut secret) = ([0; 33], [0; 65]);
    let (Some(to_name), Some(to_secret)) =
        (name.get_mut(..ssid.len()), secret.get_mut(..password.len()))
    else {
        return false;
    };
    to_name.copy_from_slice(ssid.as_bytes());
    to_secret.copy_from_slice(password.as_bytes());
    match (CStr::from_bytes_until_nul(&name), CStr::from_bytes_until_nul(&secret)) {
        (Ok(name), Ok(secret)) => f(name, secret),
        _ => false,
    }
}

impl wifi::Radio for Control {
    async fn join(&mut self, ssid: &str, password: &str) -> bool {
        if !with_texts(ssid, password, platform::wifi_station) {
            return false;
        }
        let started = Instant::now();
        while !platform::is_link_up() {
            if started.elapsed() > JOIN {
                return false;
            }
            Timer::after(LOOK).await;
        }
        true
    }

    async fn lost(&mut self) {
        let mut seen = Instant::now();
        while seen.elapsed() < GONE {
            Timer::after(LOOK).await;
            if platform::is_link_up() {
                seen = Instant::now();
            }
        }
    }

    async fn open(&mut self, ssid: &str, password: &str, channel: u8) -> bool {
        with_texts(ssid, password, |name, secret| {
            platform::wifi_access_point(name, secret, channel)
        })
    }
}
