//! Wi-Fi connection of a bridge: joins the configured network, falls back to an access point, and returns. Includes
//! addresses and name.
//!
//! ```text
//! station: join ─ joined ─▶ address (DHCP or fixed) ─ lost ─▶ join ...
//!            └─ fails for `fallback_s` ─▶ own network ─ no client for a minute ─▶ join ...
//! access point: own network, 192.168.4.1, with a DHCP server
//! ```

use core::future::pending;
use core::net::{Ipv4Addr, SocketAddrV4};

use embassy_futures::join::join;
use embassy_futures::select::select;
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_net::{ConfigV4, DhcpConfig, IpAddress, Ipv4Cidr, Stack, StaticConfigV4};
use embassy_time::{Duration, Instant, Timer, with_timeout};

use crate::settings::{Settings, WifiRole};
use crate::shell::Shared;
use crate::{dhcp, mdns};

/// Radio of a chip. It is one interface of the network stack in both roles.
#[allow(async_fn_in_trait)] // Why: a bridge is one task, so nothing must be `Send`.
pub trait Radio {
    /// Tries once to join a network, for about ten seconds. Returns whether it succeeded. An empty password means an
    /// open network.
    async fn join(&mut self, ssid: &str, password: &str) -> bool;

    /// Returns when the joined network is lost.
    async fn lost(&mut self);

    /// Opens an access point. Returns whether it succeeded. An empty password leaves the network open.
    async fn open(&mut self, ssid: &str, password: &str, channel: u8) -> bool;
}

/// Address of a bridge as an access point.
pub const OWN_ADDRESS: Ipv4Addr = Ipv4Addr::new(192, 168, 4, 1);
/// Number of sockets that this module opens.
pub const SOCKETS: usize = 2;

/// Memory of this module's sockets.
#[derive(Debug)]
pub struct Buffers {
    leases: dhcp::Leases,
    dhcp: Socket<DHCP_REQUEST, { dhcp::ANSWER }>,
    mdns: Socket<MDNS_QUERY, { mdns::ANSWER }>,
}

#[derive(Debug)]
struct Socket<const IN: usize, const OUT: usize> {
    meta_in: [PacketMetadata; 1],
    bytes_in: [u8; IN],
    meta_out: [PacketMetadata; 1],
    bytes_out: [u8; OUT],
}

/// Longest request that a station may send to an unknown server (RFC 2131, section 2) [bytes].
const DHCP_REQUEST: usize = 548;
/// Longest accepted query [bytes]: enough for one name; longer ones query many services.
const MDNS_QUERY: usize = 256;

impl<const IN: usize, const OUT: usize> Socket<IN, OUT> {
    const fn new() -> Self {
        Self {
            meta_in: [PacketMetadata::EMPTY],
            bytes_in: [0; IN],
            meta_out: [PacketMetadata::EMPTY],
            bytes_out: [0; OUT],
        }
    }

    fn open<'a>(&'a mut self, stack: Stack<'a>, port: u16) -> UdpSocket<'a> {
        let Self { meta_in, bytes_in, meta_out, bytes_out } = self;
        let mut socket = UdpSocket::new(stack, meta_in, bytes_in, meta_out, bytes_out);
        // Cannot fail: the port is not 0 and the socket is new.
        let _ = socket.bind(port);
        socket
    }
}

impl Default for Buffers {
    fn default() -> Self {
        Self::new()
    }
}

impl Buffers {
    /// Empty buffers; `const`, for a chip's static memory.
    pub const fn new() -> Self {
        Self { leases: dhcp::Leases::new(), dhcp: Socket::new(), mdns: Socket::new() }
    }
}

/// Keeps the bridge on a network, forever.
pub async fn run<R: Radio>(
    shared: &Shared,
    stack: Stack<'_>,
    radio: &mut R,
    buffers: &mut Buffers,
) -> ! {
    let Buffers { leases, dhcp, mdns } = buffers;
    // If the stack has no space for another multicast group, only the name is not found.
    let _ = stack.join_multicast_group(IpAddress::Ipv4(mdns::GROUP.0));
    join(
        keep(shared, stack, radio),
        join(
            give_addresses(stack, leases, dhcp.open(stack, 67)),
            answer_to_name(shared, stack, mdns.open(stack, mdns::GROUP.1)),
        ),
    )
    .await;
    // Unreachable: none of the three ends.
    pending().await
}

/// Joins the configured network, falls back to the own one, and returns.
async fn keep<R: Radio>(shared: &Shared, stack: Stack<'_>, radio: &mut R) {
    loop {
        let settings = shared.with(|bridge, now| {
            bridge.ensure_password(now);
            bridge.settings().clone()
        });
        let joins = settings.wifi_role == WifiRole::Station && !settings.ssid.is_empty();
        if joins {
            be_station(stack, radio, &settings).await;
        }
        let name = shared.with(|bridge, _| bridge.network_name());
        stack.set_config_v4(ConfigV4::None);
        let password = if settings.wifi_open { "" } else { settings.ap_password.as_str() };
        if !radio.open(&name, password, settings.wifi_channel).await {
            Timer::after(Duration::from_secs(1)).await;
            continue;
        }
        stack.set_config_v4(ConfigV4::Static(fixed(OWN_ADDRESS, 24, None)));
        if !joins {
            pending::<()>().await;
        }
        // Do not leave the fallback network while it is in use: return only without clients and if the vehicle is
        // disarmed.
        let mut lonely_since = Instant::now();
        while lonely_since.elapsed() < LONELY {
            Timer::after(Duration::from_secs(1)).await;
            if shared.with(|bridge, _| bridge.is_armed() || bridge.clients().next().is_some()) {
                lonely_since = Instant::now();
            }
        }
    }
}

/// Time without clients after which the configured network is tried again.
const LONELY: Duration = Duration::from_secs(60);

/// Runs as a station. Returns after the fallback time without a connection.
async fn be_station<R: Radio>(stack: Stack<'_>, radio: &mut R, settings: &Settings) {
    let patience = Duration::from_secs(settings.fallback_s.into());
    let mut without_since = Instant::now();
    while without_since.elapsed() < patience {
        if !radio.join(&settings.ssid, &settings.password).await {
            Timer::after(Duration::from_millis(500)).await;
            continue;
        }
        stack.set_config_v4(match settings.address {
            Some((address, prefix)) => ConfigV4::Static(fixed(address, prefix, settings.gateway)),
            None => ConfigV4::Dhcp(dhcp_config(settings)),
        });
        let mut has_address = false;
        let address = async {
            has_address = with_timeout(patience, stack.wait_config_up()).await.is_ok();
            if has_address {
                pending::<()>().await;
            }
            // A network without an address counts as not joined.
        };
        select(radio.lost(), address).await;
        stack.set_config_v4(ConfigV4::None);
        if has_address {
            without_since = Instant::now();
        }
    }
}

fn fixed(address: Ipv4Addr, prefix: u8, gateway: Option<Ipv4Addr>) -> StaticConfigV4 {
    StaticConfigV4 {
        address: Ipv4Cidr::new(address, prefix),
        gateway,
        dns_servers: heapless::Vec::new(),
    }
}

fn dhcp_config(settings: &Settings) -> DhcpConfig {
    let mut config = DhcpConfig::default();
    config.hostname = settings.hostname.as_str().try_into().ok();
    config
}

/// Serves DHCP in the bridge's own network.
async fn give_addresses(stack: Stack<'_>, leases: &mut dhcp::Leases, mut socket: UdpSocket<'_>) {
    let everybody = SocketAddrV4::new(Ipv4Addr::BROADCAST, 68);
    let mut answer = [0; dhcp::ANSWER];
    loop {
        // Wait before reading the address: the stack cannot be used while it lends out a datagram.
        socket.wait_recv_ready().await;
        let own = own_address(stack) == Some(OWN_ADDRESS);
        let len = socket
            .recv_from_with(|request, _| {
                own.then(|| leases.answer(OWN_ADDRESS, request, &mut answer)).flatten()
            })
            .await;
        if let Some(len) = len {
            // If the answer is lost, the station repeats its request.
            let _ = socket.send_to(&answer[..len], everybody).await;
        }
    }
}

/// Answers mDNS queries for the bridge's name.
async fn answer_to_name(shared: &Shared, stack: Stack<'_>, mut socket: UdpSocket<'_>) {
    let group = SocketAddrV4::new(mdns::GROUP.0, mdns::GROUP.1);
    let mut answer = [0; mdns::ANSWER];
    loop {
        socket.wait_recv_ready().await;
        let address = own_address(stack);
        let name = shared.with(|bridge, _| bridge.settings().hostname.clone());
        let len = socket
            .recv_from_with(|query, _| mdns::answer(query, &name, address?, &mut answer))
            .await;
        if let Some(len) = len {
            let _ = socket.send_to(&answer[..len], group).await;
        }
    }
}

fn own_address(stack: Stack<'_>) -> Option<Ipv4Addr> {
    stack.config_v4().map(|config| config.address.address())
}
