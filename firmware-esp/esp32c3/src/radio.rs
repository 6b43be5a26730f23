//! The radio as one Ethernet interface for all networks.
//!
//! The chip has a separate interface, with its own address, for each role. The network stack sees one interface that
//! changes its address, so a bridge that falls back to its access point keeps its sockets.

use core::cell::Cell;
use core::sync::atomic::{AtomicI8, Ordering};
use core::task::Context;

use critical_section::Mutex;
use embassy_futures::select::select;
use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState};
use embassy_sync::waitqueue::AtomicWaker;
use embassy_time::{Duration, Timer, with_timeout};
use esp_println::println;
use esp_radio::wifi::ap::AccessPointConfig;
use esp_radio::wifi::sta::StationConfig;
use esp_radio::wifi::{
    AuthenticationMethodConfig, Config, Interface, PowerSaveMode, WifiController,
};
use vizflyt_bridge::wifi;

/// Current role of the radio.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// Not connected, while the role changes.
    Off,
    /// Joined another network.
    Station,
    /// Opened an access point.
    AccessPoint,
}

static ROLE: Mutex<Cell<Role>> = Mutex::new(Cell::new(Role::Off));
static CHANGED: AtomicWaker = AtomicWaker::new();

/// Sets the interface that the network stack uses.
pub(crate) fn set_role(role: Role) {
    critical_section::with(|section| ROLE.borrow(section).set(role));
    CHANGED.wake();
}

pub(crate) fn role() -> Role {
    critical_section::with(|section| ROLE.borrow(section).get())
}

/// Network driver for the stack.
pub(crate) struct Radio {
    station: Interface,
    access_point: Interface,
}

impl Radio {
    /// Takes both interfaces of the chip; call it once.
    pub(crate) fn new() -> Self {
        Self { station: Interface::station(), access_point: Interface::access_point() }
    }

    fn current(&mut self) -> &mut Interface {
        if role() == Role::AccessPoint { &mut self.access_point } else { &mut self.station }
    }
}

impl Driver for Radio {
    type RxToken<'a> = <Interface as Driver>::RxToken<'a>;
    type TxToken<'a> = <Interface as Driver>::TxToken<'a>;

    fn receive(&mut self, cx: &mut Context<'_>) -> Option<(Self::RxToken<'_>, Self::TxToken<'_>)> {
        CHANGED.register(cx.waker());
        Driver::receive(self.current(), cx)
    }

    fn transmit(&mut self, cx: &mut Context<'_>) -> Option<Self::TxToken<'_>> {
        CHANGED.register(cx.waker());
        Driver::transmit(self.current(), cx)
    }

    fn link_state(&mut self, cx: &mut Context<'_>) -> LinkState {
        CHANGED.register(cx.waker());
        match role() {
            Role::Off => LinkState::Down,
            Role::Station | Role::AccessPoint => self.current().link_state(cx),
        }
    }

    fn capabilities(&self) -> Capabilities {
        self.station.capabilities()
    }

    fn hardware_address(&self) -> HardwareAddress {
        let interface =
            if role() == Role::AccessPoint { &self.access_point } else { &self.station };
        interface.hardware_address()
    }
}

/// Control of the radio for the bridge.
pub(crate) struct Control {
    controller: WifiController<'static>,
}

/// Timeout of joining a network.
const JOIN: Duration = Duration::from_secs(10);

static SIGNAL_DBM: AtomicI8 = AtomicI8::new(0);

/// Returns the signal strength of the joined network [dBm].
pub(crate) fn signal_dbm() -> Option<i8> {
    match SIGNAL_DBM.load(Ordering::Relaxed) {
        0 => None,
        dbm => Some(dbm),
    }
}

impl Control {
    pub(crate) fn new(controller: WifiController<'static>) -> Self {
        Self { controller }
    }

    fn configure(&mut self, config: &Config) -> bool {
        let done = self.controller.set_config(config);
        // Power saving between beacons would add at least 100 ms of latency.
        let awake = self.controller.set_power_saving(PowerSaveMode::None);
        match done.and(awake) {
            Ok(()) => true,
            Err(error) => {
                println!("the radio rejected its configuration: {error:?}");
                false
            }
        }
    }
}

/// Returns WPA2, or an open network if the password is empty.
fn authentication(password: &str) -> Option<AuthenticationMethodConfig> {
    if password.is_empty() {
        return Some(AuthenticationMethodConfig::Open);
    }
    password.try_into().ok().map(AuthenticationMethodConfig::Wpa2Personal)
}

impl wifi::Radio for Control {
    async fn join(&mut self, ssid: &str, password: &str) -> bool {
        set_role(Role::Off);
        let (Ok(ssid), Some(authentication)) = (ssid.try_into(), authentication(password)) else {
            return false;
        };
        let config = StationConfig::default().with_ssid(ssid).with_authentication(authentication);
        if !self.configure(&Config::Station(config)) {
            return false;
        }
        match with_timeout(JOIN, self.controller.connect_async()).await {
            Ok(Ok(_)) => {
                set_role(Role::Station);
                true
            }
            Ok(Err(error)) => {
                println!("not joined: {error:?}");
                false
            }
            Err(_) => false,
        }
    }

    async fn lost(&mut self) {
        let listen = async {
            loop {
                let dbm = self.controller.rssi().ok().and_then(|dbm| i8::try_from(dbm).ok());
                SIGNAL_DBM.store(dbm.unwrap_or(0), Ordering::Relaxed);
                Timer::after(Duration::from_secs(1)).await;
            }
        };
        select(self.controller.wait_for_disconnect_async(), listen).await;
        SIGNAL_DBM.store(0, Ordering::Relaxed);
        set_role(Role::Off);
    }

    async fn open(&mut self, ssid: &str, password: &str, channel: u8) -> bool {
        set_role(Role::Off);
        let (Ok(ssid), Some(authentication)) = (ssid.try_into(), authentication(password)) else {
            return false;
        };
        let config = AccessPointConfig::default()
            .with_ssid(ssid)
            .with_authentication(authentication)
            .with_channel(channel);
        let open = self.configure(&Config::AccessPoint(config));
        if open {
            // Printed only on USB, so reading it needs physical access to the board.
            println!("own network {ssid:?}, channel {channel}, password {password:?}");
            set_role(Role::AccessPoint);
        }
        open
    }
}
