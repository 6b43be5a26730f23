//! Sockets of the bridge: datagrams in and out, TCP clients.

use core::cell::RefCell;
use core::net::SocketAddrV4;

use embassy_futures::join::{join, join_array, join4};
use embassy_futures::select::select3;
use embassy_net::tcp::TcpSocket;
use embassy_net::udp::{PacketMetadata, UdpMetadata, UdpSocket};
use embassy_net::{IpAddress, IpEndpoint, Stack};
use embassy_time::{Duration, Timer, with_timeout};
use embedded_io_async::Write;

use super::page::show_page;
use super::{Buffers, Platform, SendOnly, Shared, TcpBuffers, wait};

/// Serves UDP, TCP and the web page on one stack.
pub(super) async fn serve<P: Platform>(
    shared: &Shared,
    stack: Stack<'_>,
    platform: &RefCell<&mut P>,
    buffers: &mut Buffers,
) {
    let (udp_port, tcp_port) =
        shared.take(|bridge, _| (bridge.settings().udp_port, bridge.settings().tcp_port));
    let Buffers { udp_in_meta, udp_in, udp_out_meta, udp_out, datagram_out, silent, tcp, page } =
        buffers;
    let SendOnly { meta, bytes, datagram } = silent;
    // Three sockets on one port, one per direction. Input goes to the one bound first.
    let (mut no_meta, mut none) = ([[PacketMetadata::EMPTY]; 3], [[0]; 3]);
    let ([no_a, no_b, no_c], [none_a, none_b, none_c]) = (&mut no_meta, &mut none);
    let mut incoming = UdpSocket::new(stack, udp_in_meta, udp_in, no_a, none_a);
    let mut to_speaking = UdpSocket::new(stack, no_b, none_b, udp_out_meta, udp_out);
    let mut to_silent = UdpSocket::new(stack, no_c, none_c, meta, bytes);
    // Cannot fail: the port is not 0 and the sockets are new.
    let _ = incoming.bind(udp_port);
    let receive = receive_udp(shared, &mut incoming);
    let send_speaking = async {
        loop {
            let _ = to_speaking.bind(udp_port);
            loop {
                let next = shared.take(|bridge, now| bridge.poll_udp_speaking(now, datagram_out));
                let Some((to, len)) = next else {
                    let due = shared.take(|bridge, now| bridge.speaking_due(now));
                    wait(&shared.udp, due).await;
                    continue;
                };
                let sent = to_speaking.send_to(&datagram_out[..len], endpoint(to));
                match with_timeout(STUCK, sent).await {
                    Ok(Ok(())) => {}
                    Ok(Err(_)) => shared.take(|bridge, _| bridge.note_not_sent()),
                    Err(_) => break,
                }
            }
            // The receiver of the first datagram is gone and its address cannot be resolved. Closing the socket empties
            // the queue.
            shared.take(|bridge, _| bridge.note_not_sent());
            to_speaking.close();
        }
    };
    let _ = to_silent.bind(udp_port);
    let send_silent = async {
        loop {
            let next = shared.take(|bridge, now| bridge.poll_udp_silent(now, datagram));
            let Some((to, len)) = next else {
                wait(&shared.silent, shared.take(|bridge, now| bridge.silent_due(now))).await;
                continue;
            };
            if to_silent.send_to(&datagram[..len], endpoint(to)).await.is_err() {
                shared.take(|bridge, _| bridge.note_not_sent());
            }
        }
    };
    let mut slots = 0..;
    let connections = tcp
        .each_mut()
        .map(|buffers| connection(shared, stack, tcp_port, slots.next().unwrap_or(0), buffers));
    let send = join(send_speaking, send_silent);
    join4(receive, send, join_array(connections), show_page(shared, stack, platform, page)).await;
}

/// Maximum time to send a datagram. The stack blocks its queue forever on a datagram whose receiver is gone; the
/// address of a connected receiver resolves at once.
const STUCK: Duration = Duration::from_secs(1);

/// Passes received datagrams to the bridge, forever, without copying them.
async fn receive_udp(shared: &Shared, socket: &mut UdpSocket<'_>) {
    loop {
        let take = |bytes: &[u8], meta: UdpMetadata| {
            let IpAddress::Ipv4(address) = meta.endpoint.addr;
            let from = SocketAddrV4::new(address, meta.endpoint.port);
            shared.with(|bridge, now| bridge.handle_datagram(now, from, bytes));
        };
        socket.recv_from_with(take).await;
    }
}

fn endpoint(to: SocketAddrV4) -> IpEndpoint {
    IpEndpoint::new(IpAddress::Ipv4(*to.ip()), to.port())
}

/// Serves TCP clients, one after the other.
async fn connection(
    shared: &Shared,
    stack: Stack<'_>,
    port: u16,
    slot: u8,
    buffers: &mut TcpBuffers,
) {
    if port == 0 {
        return;
    }
    let TcpBuffers { receive, transmit, batch } = buffers;
    let wake = &shared.tcp[usize::from(slot)];
    loop {
        let mut socket = TcpSocket::new(stack, receive, transmit);
        if socket.accept(port).await.is_err() {
            Timer::after(Duration::from_millis(100)).await;
            continue;
        }
        // Packets must not wait for each other, and a disconnected client must free its slot.
        socket.set_nagle_enabled(false);
        socket.set_timeout(Some(Duration::from_secs(10)));
        socket.set_keep_alive(Some(Duration::from_secs(3)));
        shared.with(|bridge, now| bridge.open_stream(now, slot));
        {
            let (mut reader, mut writer) = socket.split();
            let read = async {
                let mut bytes = [0; 128];
                while let Ok(len @ 1..) = reader.read(&mut bytes).await {
                    shared.with(|bridge, now| bridge.handle_stream(now, slot, &bytes[..len]));
                }
            };
            let write = async {
                loop {
                    match shared.take(|bridge, now| bridge.poll_tcp(now, slot, batch)) {
                        0 => wait(wake, shared.take(|bridge, _| bridge.tcp_due(slot))).await,
                        len => {
                            if writer.write_all(&batch[..len]).await.is_err() {
                                return;
                            }
                        }
                    }
                }
            };
            let stalled = async {
                while shared.take(|bridge, _| bridge.is_open(slot)) {
                    Timer::after(Duration::from_secs(1)).await;
                }
            };
            select3(read, write, stalled).await;
        }
        shared.with(|bridge, _| bridge.close_stream(slot));
        socket.abort();
        // A reset connection has nothing to flush.
        let _ = socket.flush().await;
    }
}
