//! Reads one HTTP request, of which little is kept: the first line, and the body of a form. Bytes come in
//! any portions; whatever they are, memory is bounded.

/// Bytes of the first line that are kept: our paths are short.
const LINE: usize = 48;
/// Bytes of another line that are looked at: longer than what we look for.
const FIELD: usize = 64;
/// Bytes of a head at most; browsers send a quarter of it.
const HEAD: u32 = 4096;
/// Bytes of a form at most.
pub const BODY: usize = 384;

/// A request as far as it has come.
#[derive(Clone, Debug)]
pub struct Request {
    line: [u8; LINE],
    line_len: usize,
    field: [u8; FIELD],
    field_len: usize,
    body: [u8; BODY],
    body_len: usize,
    /// Bytes of the head so far.
    head: u32,
    /// Length of the body, as the head says. [bytes]
    announced: usize,
    stage: Stage,
    /// Another site's page has sent it.
    is_foreign: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Line,
    Fields,
    Body,
    Whole,
    TooLong,
}

/// How far a request is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// More is to come.
    More,
    /// It can be answered.
    Whole,
    /// It brings a firmware (`POST /update`), which begins here in the bytes just given.
    Firmware(usize),
}

impl Default for Request {
    fn default() -> Self {
        Self::new()
    }
}

impl Request {
    /// Nothing yet; `const`, for a chip's static memory.
    pub const fn new() -> Self {
        Self {
            line: [0; LINE],
            line_len: 0,
            field: [0; FIELD],
            field_len: 0,
            body: [0; BODY],
            body_len: 0,
            head: 0,
            announced: 0,
            stage: Stage::Line,
            is_foreign: false,
        }
    }

    /// Begins anew: the connection is another one.
    pub fn restart(&mut self) {
        *self = Self::new();
    }

    /// Takes bytes; those behind a whole request are left.
    pub fn push(&mut self, bytes: &[u8]) -> Progress {
        for (place, &byte) in bytes.iter().enumerate() {
            match self.stage {
                Stage::Line | Stage::Fields => {
                    self.take_head(byte);
                    if self.stage == Stage::Body && self.is(b"POST /update ") {
                        self.stage = Stage::Whole;
                        return Progress::Firmware(place + 1);
                    }
                }
                Stage::Body => {
                    self.body[self.body_len] = byte;
                    self.body_len += 1;
                    self.settle_body();
                }
                Stage::Whole | Stage::TooLong => break,
            }
        }
        match self.stage {
            Stage::Whole | Stage::TooLong => Progress::Whole,
            Stage::Line | Stage::Fields | Stage::Body => Progress::More,
        }
    }

    /// Whether the first line begins so.
    pub fn is(&self, line: &[u8]) -> bool {
        self.line[..self.line_len].starts_with(line)
    }

    /// Whether it is longer than anything that we serve.
    pub fn is_too_long(&self) -> bool {
        self.stage == Stage::TooLong
    }

    /// Whether a browser has said that another site's page sent it.
    pub fn is_foreign(&self) -> bool {
        self.is_foreign
    }

    /// Returns the form that came with it; empty if none has.
    pub fn body(&self) -> &[u8] {
        &self.body[..self.body_len]
    }

    fn take_head(&mut self, byte: u8) {
        self.head += 1;
        if self.head > HEAD {
            self.stage = Stage::TooLong;
            return;
        }
        if self.stage == Stage::Line {
            if byte == b'\n' {
                self.stage = Stage::Fields;
            } else if let Some(place) = self.line.get_mut(self.line_len) {
                *place = byte;
                self.line_len += 1;
            }
            return;
        }
        match byte {
            b'\n' if self.field_len == 0 => {
                self.stage = Stage::Body;
                self.settle_body();
            }
            b'\n' => {
                self.read_field();
                self.field_len = 0;
            }
            b'\r' => {}
            _ => {
                if let Some(place) = self.field.get_mut(self.field_len) {
                    *place = byte;
                    self.field_len += 1;
                }
            }
        }
    }

    /// Looks at one field of the head.
    fn read_field(&mut self) {
        let Ok(field) = core::str::from_utf8(&self.field[..self.field_len]) else { return };
        let Some((name, value)) = field.split_once(':') else { return };
        let value = value.trim();
        if name.eq_ignore_ascii_case("content-length") {
            // What is no number is no body; it is refused as a form without its fields.
            self.announced = value.parse().unwrap_or(0);
        } else if name.eq_ignore_ascii_case("sec-fetch-site") {
            self.is_foreign = matches!(value, "cross-site" | "same-site");
        }
    }

    /// Looks whether the body is whole.
    fn settle_body(&mut self) {
        if self.is(b"POST /update ") {
            // A firmware is not kept.
        } else if !self.is(b"POST /settings ") || self.body_len >= self.announced {
            self.stage = Stage::Whole;
        } else if self.announced > BODY {
            self.stage = Stage::TooLong;
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::string::String;
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    fn read(bytes: &[u8], chunk: usize) -> (Request, Progress, usize) {
        let (mut request, mut used) = (Request::new(), 0);
        for part in bytes.chunks(chunk) {
            match request.push(part) {
                Progress::More => used += part.len(),
                Progress::Firmware(from) => return (request, Progress::Firmware(0), used + from),
                Progress::Whole => return (request, Progress::Whole, used),
            }
        }
        (request, Progress::More, used)
    }

    const FORM: &[u8] = b"POST /settings HTTP/1.1\r\nHost: 192.168.4.1\r\nSec-Fetch-Site: \
        same-origin\r\nCONTENT-LENGTH:  7 \r\nUser-Agent: a browser with a name that is longer than any \
        line we keep, as they are\r\n\r\nkey=abcmore";

    #[test]
    fn requests_are_read_in_any_portions() {
        let update = b"POST /update HTTP/1.0\r\n\r\nVZU1 and so on";
        for chunk in 1..FORM.len() {
            let (request, progress, _) = read(FORM, chunk);
            assert_eq!((progress, request.body()), (Progress::Whole, &b"key=abc"[..]), "{chunk}");
            assert!(request.is(b"POST /settings ") && !request.is_foreign());
            let (request, progress, _) = read(b"GET /stats.json HTTP/1.1\r\n\r\n", chunk);
            assert!(progress == Progress::Whole && request.is(b"GET /stats.json "));
            let (_, progress, from) = read(update, chunk);
            assert_eq!(
                (progress, &update[from..]),
                (Progress::Firmware(0), &b"VZU1 and so on"[..])
            );
        }
        assert_eq!(read(&FORM[..FORM.len() - 5], 64).1, Progress::More);
        assert!(
            read(b"POST /settings HTTP/1.1\r\nContent-Length: 4000\r\n\r\n", 9).0.is_too_long()
        );
        assert_eq!(read(b"POST /settings HTTP/1.1\r\n\r\n", 9).1, Progress::Whole);
        let foreign = b"POST /settings HTTP/1.1\r\nsec-fetch-site: cross-site\r\n\r\n";
        assert!(read(foreign, 9).0.is_foreign());
    }

    proptest! {
        #[test]
        fn any_bytes_in_any_portions_read_alike(
            bytes in prop::collection::vec(any::<u8>(), 0..2000),
            head in prop::sample::select(std::vec!["", "GET / ", "POST /settings HTTP/1.1\r\n"]),
            chunk in 1..700usize,
        ) {
            let whole: Vec<u8> = [head.as_bytes(), &bytes].concat();
            let (one, one_progress, _) = read(&whole, 1);
            let (other, other_progress, _) = read(&whole, chunk);
            prop_assert_eq!(one_progress, other_progress);
            prop_assert_eq!(one.body(), other.body());
            prop_assert_eq!(String::from_utf8_lossy(&one.line), String::from_utf8_lossy(&other.line));
        }

        #[test]
        fn endless_heads_end(byte in any::<u8>()) {
            let (request, progress, used) = read(&std::vec![byte | 0x20; 10_000], 100);
            prop_assert!(progress == Progress::Whole && request.is_too_long() && used <= 4200);
        }
    }
}
