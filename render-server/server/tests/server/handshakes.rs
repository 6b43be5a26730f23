//! Unfinished handshakes: a paired runtime can connect during them, even from the same address.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::support::{Client, Server, write_arena};
use quinn::{ClientConfig, Endpoint, TransportConfig};
use vizflyt_trust::tls::Pin;
use vizflyt_trust::{ALPN, Identity};

/// Begins 40 handshakes per second from a real address: answers a Retry, and then stays silent.
fn begin_and_leave(server: &Server, stop: &Arc<AtomicBool>) {
    let endpoint = Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    let (own, to) = (endpoint.local_addr().unwrap(), server.quic);
    let [near, far] = [(); 2].map(|()| Arc::new(UdpSocket::bind("127.0.0.1:0").unwrap()));
    let mouth = near.local_addr().unwrap();
    let pass = |from: &Arc<UdpSocket>, on: &Arc<UdpSocket>, to, is_passed: fn(u8) -> bool| {
        let (from, on, ended) = (from.clone(), on.clone(), stop.clone());
        from.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        std::thread::spawn(move || {
            let mut packet = vec![0; 65_536];
            while !ended.load(Ordering::Relaxed) {
                if let Ok((len, _)) = from.recv_from(&mut packet)
                    && is_passed(packet[0])
                {
                    let _ = on.send_to(&packet[..len], to);
                }
            }
        });
    };
    pass(&near, &far, to, |_| true);
    // A long header of type 3 is a Retry (RFC 9000, section 17.2).
    pass(&far, &near, own, |first| first & 0xf0 == 0xf0);
    let tls = Pin::none().client_config(&Identity::ephemeral().unwrap(), ALPN).unwrap();
    let quic = quinn::crypto::rustls::QuicClientConfig::try_from(tls).unwrap();
    let config = ClientConfig::new(Arc::new(quic));
    let ended = stop.clone();
    tokio::spawn(async move {
        let mut begun = Vec::new();
        let mut tick = tokio::time::interval(Duration::from_millis(25));
        while !ended.load(Ordering::Relaxed) {
            tick.tick().await;
            begun.push(endpoint.connect_with(config.clone(), mouth, "vizflyt").unwrap());
        }
    });
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_runtime_connects_during_forty_half_open_handshakes_per_second() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let stop = Arc::new(AtomicBool::new(false));
    begin_and_leave(&server, &stop);
    // Longer than the timeout of a handshake.
    tokio::time::sleep(Duration::from_secs(5)).await;
    let mut took = Vec::new();
    for _ in 0..10 {
        let start = Instant::now();
        let (client, _) = Client::welcomed(&server, TransportConfig::default()).await;
        took.push(start.elapsed().as_secs_f64() * 1e3);
        client.close().await;
    }
    took.sort_by(f64::total_cmp);
    println!("welcomed within {:.0} ms, at most {:.0} ms", took[5], took[9]);
    stop.store(true, Ordering::Relaxed);
}
