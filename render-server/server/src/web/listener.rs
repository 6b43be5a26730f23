//! The page's listener: admits connections ([`crate::admission`]) and serves HTTP/1.1, inside TLS if set. It also
//! serves the stop button, so connections without credentials must never block it.
//!
//! ```text
//! accept -> slot without credentials: the newest gets one; the oldest waiting one of its address closes
//!        -> TLS, if set -> head within 15 s -> guard: body within 5 s, and credentials
//!        -> slot of a team or an instructor, which connections without credentials cannot take
//! ```

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use axum::Router;
use axum::extract::ConnectInfo;
use axum::http::HeaderValue;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::Notify;
use tokio::time::{MissedTickBehavior, interval};
use tracing::{debug, warn};

use super::access::{self, Viewer};
use super::https::PageTls;
use crate::admission::{Admission, Holder, Limits, PlaceId};
use crate::stop::Stop;
use vizflyt_process::descriptors::{self, Reserve};
use vizflyt_process::lock;

/// Binds the page's address.
///
/// # Errors
/// The system's error, and what to do.
pub(crate) fn bind(address: SocketAddr) -> Result<TcpListener> {
    let open = || -> io::Result<TcpListener> {
        let socket = if address.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
        // Allows a restart while old connections of the port are in TIME_WAIT.
        socket.set_reuseaddr(true)?;
        socket.bind(address)?;
        socket.listen(BACKLOG)
    };
    open().with_context(|| {
        format!("cannot listen on {address} (page); is the port taken? try --http 127.0.0.1:0")
    })
}

/// Admission of connections to the page.
#[derive(Debug)]
struct Door {
    admission: Mutex<Admission<Arc<Notify>>>,
}

/// Slot of a connection, freed when the last clone is dropped.
#[derive(Clone, Debug)]
pub(super) struct ConnectionPlace(Arc<Held>);

#[derive(Debug)]
struct Held {
    door: Arc<Door>,
    id: PlaceId,
}

impl Drop for Held {
    fn drop(&mut self) {
        lock(&self.door.admission).leave(self.id);
    }
}

impl Door {
    fn new(descriptors: usize) -> Arc<Self> {
        Arc::new(Self { admission: Mutex::new(Admission::new(limits(descriptors))) })
    }

    /// Returns a slot for a connection from `address`, and the signal that asks it to close; `None` if all are taken.
    fn admit(self: &Arc<Self>, address: IpAddr) -> Option<(ConnectionPlace, Arc<Notify>)> {
        let gives_way = Arc::new(Notify::new());
        let admitted = lock(&self.admission).admit(Instant::now(), address, gives_way.clone());
        let (id, out) = admitted?;
        tell(out);
        Some((ConnectionPlace(Arc::new(Held { door: self.clone(), id })), gives_way))
    }

    fn make_room(&self) {
        let out = lock(&self.admission).make_room();
        tell(out);
    }

    fn send_away_overdue(&self) {
        let overdue = lock(&self.admission).overdue(Instant::now(), IDLE);
        for one in overdue {
            tell(Some(one));
        }
    }
}

fn tell(gives_way: Option<Arc<Notify>>) {
    if let Some(gives_way) = gives_way {
        // `notify_one` stores a permit for a task that does not wait yet.
        gives_way.notify_one();
    }
}

impl ConnectionPlace {
    /// Marks the connection as serving a complete request, so that it is not closed for others. `viewer` is `None` for
    /// a request without credentials.
    pub(super) fn serve(&self, viewer: Option<&Viewer>) {
        let holder = viewer.map(|viewer| match viewer {
            Viewer::Instructor => Holder::Instructor,
            Viewer::Team(vehicle) => Holder::Team(vehicle.clone()),
        });
        let mut admission = lock(&self.0.door.admission);
        let out = holder.and_then(|holder| admission.recognise(self.0.id, holder));
        admission.serve(self.0.id);
        drop(admission);
        tell(out);
    }

    /// Marks the connection as waiting for its next request.
    pub(super) fn wait(&self) {
        lock(&self.0.door.admission).wait(Instant::now(), self.0.id);
    }
}

/// Returns the limits of connections for this number of descriptors: half of them, because the rest of the server needs
/// some, in four parts.
fn limits(descriptors: usize) -> Limits {
    let all = (descriptors / 2).clamp(16, MAX_CONNECTIONS);
    Limits {
        strangers: all / 2,
        by_address: all / 8,
        teams: all / 4,
        by_team: all / 16,
        instructors: all / 4,
    }
}

/// Accepts connections until the server stops. Open connections end with their current request; the next server of this
/// port gets the following ones.
pub(super) async fn serve(listener: TcpListener, tls: Option<PageTls>, router: Router, stop: Stop) {
    let door = Door::new(descriptors::raise_limit());
    let mut reserve = Reserve::default();
    reserve.fill();
    let mut sweep = interval(SWEEP_EVERY);
    sweep.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut is_short = false;
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = sweep.tick() => {
                door.send_away_overdue();
                continue;
            }
            () = stop.wait() => break,
        };
        match accepted {
            Ok((stream, from)) => {
                reserve.fill();
                let Some((place, gives_way)) = door.admit(from.ip()) else {
                    debug!("page: no place for {from}");
                    continue;
                };
                let (tls, router, stop) = (tls.clone(), router.clone(), stop.clone());
                tokio::spawn(async move {
                    tokio::select! {
                        () = talk(stream, from, place, tls, (router, stop)) => {}
                        () = gives_way.notified() => debug!("page: {from} gave way"),
                    }
                });
            }
            Err(error) if descriptors::are_used_up(&error) => {
                if !is_short {
                    is_short = true;
                    warn!("page: {error}; connections that show no key give way");
                }
                // A descriptor of the reserve is freed for the newcomer, and refilled when a connection has closed.
                door.make_room();
                if !reserve.release() {
                    tokio::time::sleep(OUT_OF_DESCRIPTORS).await;
                }
            }
            // Error of a single connection (accept(2): ECONNABORTED and network errors).
            Err(error) => debug!("page: not accepted: {error}"),
        }
    }
}

/// Serves a connection until it ends, or becomes a WebSocket.
async fn talk(
    stream: TcpStream,
    from: SocketAddr,
    place: ConnectionPlace,
    tls: Option<PageTls>,
    served: (Router, Stop),
) {
    // Send small answers immediately.
    let _ = stream.set_nodelay(true);
    let Some(tls) = tls else { return http(stream, from, place, false, served).await };
    match tls.accept(stream).await {
        Ok(stream) => http(stream, from, place, true, served).await,
        Err(error) => debug!("page: {from}: {error:#}"),
    }
}

async fn http<S>(
    stream: S,
    from: SocketAddr,
    place: ConnectionPlace,
    is_tls: bool,
    (router, stop): (Router, Stop),
) where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let router = TowerToHyperService::new(router);
    let service = service_fn(move |mut request: hyper::Request<Incoming>| {
        request.extensions_mut().insert(ConnectInfo(from));
        request.extensions_mut().insert(place.clone());
        if is_tls {
            // As a TLS proxy does, so that cookies are set `Secure`.
            let https = HeaderValue::from_static("https");
            request.headers_mut().insert(access::FORWARDED_PROTO, https);
        }
        router.call(request)
    });
    let mut builder = http1::Builder::new();
    builder
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_WITHIN)
        .max_buf_size(MAX_HEAD)
        .max_headers(MAX_HEADERS);
    let connection = builder.serve_connection(TokioIo::new(stream), service).with_upgrades();
    let mut connection = std::pin::pin!(connection);
    let served = tokio::select! {
        served = &mut connection => served,
        () = stop.wait() => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = served {
        debug!("page: {from}: {error}");
    }
}

/// A burst of connections must not make the kernel drop an instructor's SYN: its retry takes a second.
const BACKLOG: u32 = 4096;
/// Maximum number of connections. Each browser of a lecture hall opens six.
const MAX_CONNECTIONS: usize = 1024;
/// Timeout for the complete head of a request [s]; also closes idle connections.
const HEAD_WITHIN: Duration = Duration::from_secs(15);
/// Maximum idle time in any state: an answer may be stuck with a client that does not read.
const IDLE: Duration = Duration::from_mins(2);
const SWEEP_EVERY: Duration = Duration::from_secs(1);
/// Time for a connection to close after the signal.
const OUT_OF_DESCRIPTORS: Duration = Duration::from_millis(2);
/// Maximum head of a request, including cookies [bytes].
const MAX_HEAD: usize = 32 << 10;
const MAX_HEADERS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_descriptors_leave_slots_for_every_kind_of_viewer() {
        for descriptors in [64, 1024, 20_000, 1 << 20] {
            let limits = limits(descriptors);
            let all = limits.strangers + limits.teams + limits.instructors;
            assert!(all <= descriptors / 2 && all <= MAX_CONNECTIONS, "{limits:?}");
            assert!(limits.by_address < limits.strangers && limits.by_team < limits.teams);
            assert!(limits.by_address >= 2 && limits.by_team >= 2 && limits.instructors >= 4);
        }
    }
}
