//! Latency of image-sized messages over loopback with other transports, until the receiver's callback: zenoh (two
//! sessions, TCP between them) and raw TCP, one after the other in one process. `vizflyt bench stream` prints our
//! latency next to the same raw TCP, so the ratios can be compared.
//!
//! Usage: vizflyt-stream-peers [SECONDS [BYTES [HZ]]]     default 10 120000 60

use std::error::Error;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use zenoh::Wait;
use zenoh::qos::{CongestionControl, Priority};

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let mut number = |default: u64| arguments.next().map_or(Ok(default), |text| text.parse());
    let (seconds, bytes, hz) = (number(10)?, number(120_000)?, number(60)?);
    let bench = Bench {
        start: Instant::now(),
        payload: (0..bytes.max(8)).map(|n| (n.wrapping_mul(0x9e37_79b9) >> 24) as u8).collect(),
        period: Duration::from_secs_f64(1.0 / hz.max(1) as f64),
        count: seconds * hz,
    };
    println!("{bytes} bytes at {hz} Hz over loopback, sent -> received completely");
    let tcp = bench.tcp()?;
    let zenoh = bench.zenoh()?;
    println!("zenoh takes {:.2} times as long as tcp", zenoh / tcp);
    Ok(())
}

struct Bench {
    start: Instant,
    payload: Vec<u8>,
    period: Duration,
    count: u64,
}

impl Bench {
    fn now_ns(&self) -> u64 {
        self.start.elapsed().as_nanos() as u64
    }

    /// Calls `send` at each due time with the payload, which starts with the time.
    fn tick(&self, mut send: impl FnMut(&[u8]) -> Result<()>) -> Result<()> {
        let mut payload = self.payload.clone();
        let mut due = Instant::now();
        for _ in 0..self.count {
            due += self.period;
            thread::sleep(due.saturating_duration_since(Instant::now()));
            payload[..8].copy_from_slice(&self.now_ns().to_le_bytes());
            send(&payload)?;
        }
        thread::sleep(Duration::from_millis(300));
        Ok(())
    }

    /// Prints percentiles; returns the median. [ms]
    fn print(&self, name: &str, mut ms: Vec<f64>) -> Result<f64> {
        ms.sort_unstable_by(f64::total_cmp);
        let last = ms.len().checked_sub(1).ok_or("nothing arrived")?;
        let at = |share: f64| ms[(share * last as f64).round() as usize];
        println!(
            "{name:<7} p50 {:.2} ms, p99 {:.2}, max {:.2}; {} of {} received",
            at(0.5),
            at(0.99),
            at(1.0),
            ms.len(),
            self.count
        );
        Ok(at(0.5))
    }

    fn tcp(&self) -> Result<f64> {
        let listener = TcpListener::bind(("127.0.0.1", 0))?;
        let mut send = TcpStream::connect(listener.local_addr()?)?;
        send.set_nodelay(true)?;
        let mut receive = listener.accept()?.0;
        let (start, len) = (self.start, self.payload.len());
        let receiving = thread::spawn(move || {
            let (mut ms, mut image) = (Vec::new(), vec![0; len]);
            // Read until the connection closes.
            while receive.read_exact(&mut image).is_ok() {
                ms.push(age_ms(start, &image));
            }
            ms
        });
        self.tick(|payload| Ok(send.write_all(payload)?))?;
        drop(send);
        self.print("tcp", receiving.join().map_err(|_| "the receiving thread failed")?)
    }

    fn zenoh(&self) -> Result<f64> {
        let port = TcpListener::bind(("127.0.0.1", 0))?.local_addr()?.port();
        let session = |own: &str| -> Result<zenoh::Session> {
            let mut config = zenoh::Config::default();
            config.insert_json5("scouting/multicast/enabled", "false")?;
            config.insert_json5(own, &format!("[\"tcp/127.0.0.1:{port}\"]"))?;
            if own != "listen/endpoints" {
                config.insert_json5("listen/endpoints", "[]")?;
            }
            zenoh::open(config).wait()
        };
        let listening = session("listen/endpoints")?;
        let calling = session("connect/endpoints")?;
        let (sender, received) = mpsc::channel();
        let start = self.start;
        let _subscriber = listening
            .declare_subscriber("image")
            .callback(move |sample| {
                // The complete image in one piece, as an application needs it.
                let bytes = sample.payload().to_bytes();
                let _ = sender.send(age_ms(start, &bytes));
            })
            .wait()?;
        let publisher = calling
            .declare_publisher("image")
            .congestion_control(CongestionControl::Block)
            .priority(Priority::RealTime)
            .express(true)
            .wait()?;
        // Wait until the subscription has reached the publisher.
        thread::sleep(Duration::from_millis(500));
        self.tick(|payload| publisher.put(payload).wait())?;
        self.print("zenoh", received.try_iter().collect())
    }
}

fn age_ms(start: Instant, image: &[u8]) -> f64 {
    let sent = image.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
    (start.elapsed().as_nanos() as u64).saturating_sub(sent) as f64 * 1e-6
}
