//! The UART as embassy's streams. The C side buffers the bytes in its interrupt.

use core::convert::Infallible;
use core::future::poll_fn;
use core::task::Poll;

use embassy_sync::waitqueue::AtomicWaker;
use embedded_io_async::{ErrorType, Read, Write};

use crate::platform;

static READABLE: AtomicWaker = AtomicWaker::new();
static WRITABLE: AtomicWaker = AtomicWaker::new();

/// Wakes the reader: bytes were received.
pub(crate) fn readable() {
    READABLE.wake();
}

/// Wakes the writer: there is space for bytes to send.
pub(crate) fn writable() {
    WRITABLE.wake();
}

/// Receiving half of the UART.
pub(crate) struct Receiver;

impl ErrorType for Receiver {
    type Error = Infallible;
}

impl Read for Receiver {
    async fn read(&mut self, into: &mut [u8]) -> Result<usize, Infallible> {
        if into.is_empty() {
            return Ok(0);
        }
        poll_fn(|cx| {
            READABLE.register(cx.waker());
            match platform::uart_read(into) {
                0 => Poll::Pending,
                len => Poll::Ready(Ok(len)),
            }
        })
        .await
    }
}

/// Sending half of the UART.
pub(crate) struct Sender;

impl ErrorType for Sender {
    type Error = Infallible;
}

impl Write for Sender {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        if bytes.is_empty() {
            return Ok(0);
        }
        poll_fn(|cx| {
            WRITABLE.register(cx.waker());
            match platform::uart_write(bytes) {
                0 => Poll::Pending,
                len => Poll::Ready(Ok(len)),
            }
        })
        .await
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        poll_fn(|cx| {
            WRITABLE.register(cx.waker());
            if platform::uart_is_idle() { Poll::Ready(Ok(())) } else { Poll::Pending }
        })
        .await
    }
}
