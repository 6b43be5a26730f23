//! The page's listener: every connection gets a place ([`crate::admission`]), and speaks HTTP/1.1, inside TLS
//! if that is set. The stop button is behind it, so nothing that a stranger does may hold it up.
//!
//! ```text
//! accept -> place of a stranger: the newest gets one, the longest waiting of its address gives way
//!        -> TLS, if set -> a head within 15 s -> guard: a body within 5 s, and who it is
//!        -> place of a team or an instructor, which no stranger can take
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
/// The system's refusal, with what to do.
pub(crate) fn bind(address: SocketAddr) -> Result<TcpListener> {
    let open = || -> io::Result<TcpListener> {
        let socket = if address.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
        // As every server does: a port whose former connections still linger can be taken again.
        socket.set_reuseaddr(true)?;
        socket.bind(address)?;
        socket.listen(BACKLOG)
    };
    open().with_context(|| {
        format!("cannot listen on {address} (page); is the port taken? try --http 127.0.0.1:0")
    })
}

/// The places of connections to the page.
#[derive(Debug)]
struct Door {
    admission: Mutex<Admission<Arc<Notify>>>,
}

/// A connection's place; it is free again when the last copy is dropped.
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

    /// Gives a connection from `address` a place, and what tells it to give way; `None` if there is none.
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
        // One that does not look yet finds it when it does.
        gives_way.notify_one();
    }
}

impl ConnectionPlace {
    /// The connection is being served, and gives no way: with a whole request of this viewer's, or of a
    /// stranger's if `None`.
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

    /// It waits for its next request.
    pub(super) fn wait(&self) {
        lock(&self.0.door.admission).wait(Instant::now(), self.0.id);
    }
}

/// Returns how many connections there may be with so many descriptors: half of them, for the rest of
/// the server needs some too, in four parts.
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

/// Accepts connections until the server stops. Those that are open end with the request that they are at: the next one
/// belongs to whoever listens then.
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
                // The newcomer gets a descriptor of the reserve, which is filled again when somebody has gone.
                door.make_room();
                if !reserve.release() {
                    tokio::time::sleep(OUT_OF_DESCRIPTORS).await;
                }
            }
            // The connection's own trouble (accept(2): ECONNABORTED and those of its network).
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
    // Small answers leave at once.
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
            // As a proxy that speaks TLS says it: cookies are Secure then.
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

/// A burst of strangers must not make the kernel drop an instructor's SYN, which costs a second.
const BACKLOG: u32 = 4096;
/// All connections; a lecture hall's browsers have six each.
const MAX_CONNECTIONS: usize = 1024;
/// From the first byte that is waited for to the last of a request's head; an idle connection ends with it.
const HEAD_WITHIN: Duration = Duration::from_secs(15);
/// Nobody waits longer, whatever for: its answer may be stuck with a client that takes nothing.
const IDLE: Duration = Duration::from_mins(2);
const SWEEP_EVERY: Duration = Duration::from_secs(1);
/// Somebody who has been told to go needs a moment for it.
const OUT_OF_DESCRIPTORS: Duration = Duration::from_millis(2);
/// Cookies and all. [bytes]
const MAX_HEAD: usize = 32 << 10;
const MAX_HEADERS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_descriptors_leave_places_for_everybody() {
        for descriptors in [64, 1024, 20_000, 1 << 20] {
            let limits = limits(descriptors);
            let all = limits.strangers + limits.teams + limits.instructors;
            assert!(all <= descriptors / 2 && all <= MAX_CONNECTIONS, "{limits:?}");
            assert!(limits.by_address < limits.strangers && limits.by_team < limits.teams);
            assert!(limits.by_address >= 2 && limits.by_team >= 2 && limits.instructors >= 4);
        }
    }
}
