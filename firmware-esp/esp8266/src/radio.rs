//! The radio as an Ethernet interface. Frames are read and written in the platform's buffers, without copying.

use core::ffi::CStr;
use core::task::Context;

use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use embassy_sync::waitqueue::AtomicWaker;
use embassy_time::{Duration, Instant, Timer};
use vizflyt_bridge::wifi;

use crate::platform;

static WAKER: AtomicWaker = AtomicWaker::new();

/// Wakes the network stack after a change of the link or an event of frames.
pub(crate) fn changed() {
    WAKER.wake();
}

/// Network driver for the stack.
pub(crate) struct Radio {
    mac: [u8; 6],
}

impl Radio {
    pub(crate) const fn new(mac: [u8; 6]) -> Self {
        Self { mac }
    }
}

impl Driver for Radio {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sending;

    fn receive(&mut self, cx: &mut Context<'_>) -> Option<(Received, Sending)> {
        WAKER.register(cx.waker());
        if !platform::is_frame_waiting() {
            return None;
        }
        Some((Received, Sending(platform::frame_to_send()?)))
    }

    fn transmit(&mut self, cx: &mut Context<'_>) -> Option<Sending> {
        WAKER.register(cx.waker());
        platform::frame_to_send().map(Sending)
    }

    fn link_state(&mut self, cx: &mut Context<'_>) -> LinkState {
        WAKER.register(cx.waker());
        if platform::is_link_up() { LinkState::Up } else { LinkState::Down }
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = platform::FRAME;
        capabilities.max_burst_size = Some(1);
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet(self.mac)
    }
}

/// Oldest received frame.
pub(crate) struct Received;

impl RxToken for Received {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, f: F) -> R {
        platform::with_frame(f)
    }
}

/// Buffer of a frame to send.
pub(crate) struct Sending(platform::FrameToSend);

impl TxToken for Sending {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, f: F) -> R {
        self.0.send(len, f)
    }
}

/// Control of the radio for the bridge.
pub(crate) struct Control;

/// Timeout of joining a network.
const JOIN: Duration = Duration::from_secs(10);
/// Interval at which the link is polled.
const LOOK: Duration = Duration::from_millis(50);
/// Minimum length of a loss that counts: the SDK rejoins after a shorter one.
const GONE: Duration = Duration::from_secs(3);

/// Calls `f` with two C strings. A name has at most 32 bytes, a password 64.
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
