//! Parser of one HTTP request with bounded memory. It keeps only the first line and the body of a form. Bytes may be
//! split anywhere.

/// Bytes kept of the first line; all served paths are shorter.
const LINE: usize = 48;
/// Bytes kept of other lines; the fields that are read are shorter.
const FIELD: usize = 64;
/// Maximum length of a head [bytes]; browsers send about a quarter of it.
const HEAD: u32 = 4096;
/// Maximum length of a form [bytes].
pub const BODY: usize = 384;

/// Partially received request.
#[derive(Clone, Debug)]
pub struct Request {
    line: [u8; LINE],
    line_len: usize,
    field: [u8; FIELD],
    field_len: usize,
    body: [u8; BODY],
    body_len: usize,
    /// Bytes of the head received so far.
    head: u32,
    /// Length of the body according to the head [bytes].
    announced: usize,
    stage: Stage,
    /// Whether another site's page sent the request.
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

/// Progress of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// More bytes are needed.
    More,
    /// The request can be answered.
    Whole,
    /// A firmware follows (`POST /update`). It begins at this index of the bytes just pushed.
    Firmware(usize),
}

impl Default for Request {
    fn default() -> Self {
        Self::new()
    }
}

impl Request {
    /// Returns an empty request; `const`, for a chip's static memory.
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

    /// Resets the parser for a new connection.
    pub fn restart(&mut self) {
        *self = Self::new();
    }

    /// Takes bytes. Bytes after the end of the request are ignored.
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

    /// Whether the first line begins with `line`.
    pub fn is(&self, line: &[u8]) -> bool {
        self.line[..self.line_len].starts_with(line)
    }

    /// Whether the request exceeds a length limit.
    pub fn is_too_long(&self) -> bool {
        self.stage == Stage::TooLong
    }

    /// Whether the browser declared another site as the origin.
    pub fn is_foreign(&self) -> bool {
        self.is_foreign
    }

    /// Returns the body of a form; empty if there is none.
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

    /// Reads one field of the head.
    fn read_field(&mut self) {
        let Ok(field) = core::str::from_utf8(&self.field[..self.field_len]) else { return };
        let Some((name, value)) = field.split_once(':') else { return };
        let value = value.trim();
        if name.eq_ignore_ascii_case("content-length") {
            // An invalid number counts as 0. The form is then refused for its missing fields.
            self.announced = value.parse().unwrap_or(0);
        } else if name.eq_ignore_ascii_case("sec-fetch-site") {
            self.is_foreign = matches!(value, "cross-site" | "same-site");
        }
    }

    /// Ends the request if its body is complete or too long.
    fn settle_body(&mut self) {
        if self.is(b"POST /update ") {
            // A firmware is not buffered.
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
    fn parses_requests_split_anywhere() {
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
        fn parses_any_bytes_alike_however_split(
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
        fn rejects_endless_heads(byte in any::<u8>()) {
            let (request, progress, used) = read(&std::vec![byte | 0x20; 10_000], 100);
            prop_assert!(progress == Progress::Whole && request.is_too_long() && used <= 4200);
        }
    }
}
