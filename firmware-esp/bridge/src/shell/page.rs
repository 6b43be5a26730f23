//! Serves the web page and receives firmware.

use core::cell::RefCell;

use embassy_net::Stack;
use embassy_net::tcp::TcpSocket;
use embassy_time::{Duration, Timer};
use embedded_io_async::Write;

use super::{PageBuffers, Platform, Shared};
use crate::http::Progress;
use crate::page;

/// Serves the web page to one browser at a time, and receives firmware.
pub(super) async fn show_page<P: Platform>(
    shared: &Shared,
    stack: Stack<'_>,
    platform: &RefCell<&mut P>,
    buffers: &mut PageBuffers,
) {
    let port = shared.take(|bridge, _| bridge.settings().page_port);
    if port == 0 {
        return;
    }
    let PageBuffers { receive, transmit, chunk, request, answer } = buffers;
    loop {
        let mut socket = TcpSocket::new(stack, receive, transmit);
        // A browser that opens a connection in advance must not block others.
        socket.set_timeout(Some(Duration::from_secs(5)));
        if socket.accept(port).await.is_err() {
            Timer::after(Duration::from_millis(100)).await;
            continue;
        }
        request.restart();
        let (mut len, mut progress) = (0, Progress::More);
        while progress == Progress::More {
            match socket.read(chunk).await {
                Ok(more @ 1..) => {
                    len = more;
                    progress = request.push(&chunk[..len]);
                }
                _ => break,
            }
        }
        let mut restart = false;
        match progress {
            Progress::Firmware(from) => {
                let taken = take_firmware(shared, platform, &mut socket, chunk, from, len).await;
                restart = taken.is_ok();
                page::respond_firmware(taken, answer);
                let _ = socket.write_all(answer.as_bytes()).await;
                socket.close();
                // A client that is still sending reads the answer only when it is done.
                while let Ok(1..) = socket.read(chunk).await {}
            }
            Progress::Whole => {
                let done = shared.with(|bridge, now| page::act(bridge, now, request));
                let mut part = 0;
                while shared
                    .take(|bridge, now| page::respond(bridge, now, request, done, part, answer))
                {
                    // The browser has disconnected.
                    if socket.write_all(answer.as_bytes()).await.is_err() {
                        break;
                    }
                    part += 1;
                }
            }
            Progress::More => {}
        }
        socket.close();
        let _ = socket.flush().await;
        socket.abort();
        let _ = socket.flush().await;
        if restart {
            platform.borrow_mut().restart();
        }
    }
}

/// Receives a firmware: first the bytes `chunk[from..to]`, then the rest from the connection.
async fn take_firmware<P: Platform>(
    shared: &Shared,
    platform: &RefCell<&mut P>,
    socket: &mut TcpSocket<'_>,
    chunk: &mut [u8],
    mut from: usize,
    mut to: usize,
) -> Result<(), &'static str> {
    let mut first = true;
    loop {
        // Checked for every portion: an upload takes seconds, and erasing flash stops everything else.
        if shared.take(|bridge, _| bridge.is_armed()) {
            return Err("the vehicle is armed; land and disarm it first");
        }
        if platform.borrow_mut().update(first, &chunk[from..to])? {
            return Ok(());
        }
        first = false;
        from = 0;
        to = match socket.read(chunk).await {
            Ok(len @ 1..) => len,
            _ => return Err("the connection ended before the firmware did"),
        };
    }
}
