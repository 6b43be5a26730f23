//! Settings form of the web page. Reading is open; changes need the key.
//!
//! Every change contains the key in the form's body. Without a session, another site's page cannot act for the user.
//! The key crosses the network as typed, inside WPA2; `vizflyt bridge configure` proves its key without sending it.

use core::fmt::{self, Write};

use heapless::String;

use crate::access::Status;
use crate::bridge::Bridge;
use crate::settings::{NUMBERS, TEXTS};

/// Change that a form requests.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Form {
    /// Key that authorizes the change.
    pub key: String<64>,
    /// Name of the setting.
    pub name: String<64>,
    /// New value of the setting.
    pub value: String<64>,
    /// Whether to restart the bridge afterwards.
    pub restart: bool,
}

impl Form {
    /// Parses `application/x-www-form-urlencoded`. Returns `None` if a field is unknown, repeated, too long or not
    /// text.
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut form = Self::default();
        let mut seen = 0u8;
        for field in body.split(|&byte| byte == b'&') {
            let equals = field.iter().position(|&byte| byte == b'=')?;
            let (name, value) = (&field[..equals], decode(&field[equals + 1..])?);
            let place = [&b"key"[..], b"name", b"value", b"restart"]
                .iter()
                .position(|known| *known == name)?;
            if seen & (1 << place) != 0 {
                return None;
            }
            seen |= 1 << place;
            match place {
                0 => form.key = value,
                1 => form.name = value,
                2 => form.value = value,
                _ => form.restart = value == "1",
            }
        }
        // Browsers omit a box that is not ticked, so `restart` is optional.
        (seen & 0b111 == 0b111).then_some(form)
    }
}

/// Decodes `%41` and `+`.
fn decode(text: &[u8]) -> Option<String<64>> {
    let mut bytes = heapless::Vec::<u8, 64>::new();
    let mut rest = text;
    while let [first, more @ ..] = rest {
        rest = more;
        let byte = match first {
            b'+' => b' ',
            b'%' => {
                let [high, low, more @ ..] = rest else { return None };
                rest = more;
                let digit = |byte: u8| (byte as char).to_digit(16);
                (digit(*high)? << 4 | digit(*low)?) as u8
            }
            &byte => byte,
        };
        bytes.push(byte).ok()?;
    }
    // No setting contains control characters, and a line break would split a line in flash.
    let text = core::str::from_utf8(&bytes).ok()?;
    if text.chars().any(char::is_control) {
        return None;
    }
    String::try_from(text).ok()
}

/// Writes one part of the settings page. Returns false after the last part.
pub(super) fn write_part(
    bridge: &Bridge,
    part: usize,
    out: &mut impl Write,
) -> Result<bool, fmt::Error> {
    let settings = bridge.settings();
    let mut show = |name: &str| -> fmt::Result {
        write!(out, "{name:18}")?;
        escape(out, &settings.read(name).unwrap_or_default())?;
        out.write_str("\n")
    };
    match part {
        0 => {
            out.write_str(super::HTML)?;
            out.write_str("<title>settings</title><h1>Settings</h1><a href=/>counters</a><pre>")?;
            for number in NUMBERS {
                writeln!(out, "{:18}{}", number.name, number.value(settings))?;
            }
        }
        1 => TEXTS.iter().try_for_each(|&(name, _)| show(name))?,
        2 => {
            out.write_str("</pre><form method=post action=/settings><p><select name=name>")?;
            let texts = TEXTS.iter().map(|&(name, _)| name);
            for name in NUMBERS.iter().map(|number| number.name).chain(texts) {
                write!(out, "<option>{name}")?;
            }
            out.write_str(
                "</select> <input name=value maxlength=64 placeholder=value autocomplete=off>\
                 <p><input name=key type=password placeholder='key, as printed at flashing'>\
                 <p><label><input name=restart type=checkbox value=1> restart it now</label>\
                 <p><button>Change</button></form>\
                 <p>Speed, ports, pins and Wi-Fi take effect after a restart.",
            )?;
        }
        _ => return Ok(false),
    }
    Ok(true)
}

/// Writes text with HTML's special characters escaped.
fn escape(out: &mut impl Write, text: &str) -> fmt::Result {
    for letter in text.chars() {
        match letter {
            '<' => out.write_str("&lt;")?,
            '>' => out.write_str("&gt;")?,
            '&' => out.write_str("&amp;")?,
            '"' => out.write_str("&quot;")?,
            letter => out.write_char(letter)?,
        }
    }
    Ok(())
}

/// Returns the HTTP status line for the status of a change.
pub(super) fn status_line(status: Status) -> &'static str {
    match status {
        Status::Done => "200 OK",
        Status::WrongKey | Status::Unclaimed => "403 Forbidden",
        Status::Armed => "409 Conflict",
        _ => "400 Bad Request",
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::string::{String as Text, ToString};
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn accepts_or_rejects_forms_as_a_whole() {
        let check = |body: &[u8], expected: Option<(&str, &str, &str, bool)>| {
            let form = Form::parse(body);
            let read = form.as_ref().map(|f| (&*f.key, &*f.name, &*f.value, f.restart));
            assert_eq!(read, expected, "{}", Text::from_utf8_lossy(body));
        };
        check(
            b"name=LOSS_MS&value=800&key=abcd-efgh",
            Some(("abcd-efgh", "LOSS_MS", "800", false)),
        );
        check(
            b"key=k&name=wifi.ssid&value=a+b%26%C3%A9&restart=1",
            Some(("k", "wifi.ssid", "a b&\u{e9}", true)),
        );
        check(b"key=k&name=gateway&value=", Some(("k", "gateway", "", false)));
        check(b"", None);
        check(b"name=LOSS_MS&value=800", None);
        check(b"key=a&key=b&name=x&value=y", None);
        check(b"key=a&name=x&value=y&more=z", None);
        check(b"key=a&name=x&value=%0Akey%3D00", None);
        check(b"key=a&name=x&value=%4", None);
        check(b"key=a&name=x&value=%ff", None);
    }

    proptest! {
        #[test]
        fn decodes_percent_encoding(text in "[ -~\u{e9}]{0,32}") {
            let mut body = b"key=k&name=hostname&value=".to_vec();
            for byte in text.bytes() {
                body.extend(std::format!("%{byte:02X}").bytes());
            }
            let form = Form::parse(&body).unwrap();
            prop_assert_eq!(form.value.to_string(), text);
        }

        #[test]
        fn accepts_any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            if let Some(form) = Form::parse(&bytes) {
                prop_assert!(!form.value.chars().any(char::is_control));
            }
        }

        #[test]
        fn escapes_all_markup(text in ".{0,32}") {
            let mut out = Vec::new();
            let mut page = Text::new();
            escape(&mut page, &text).unwrap();
            out.extend(page.bytes());
            prop_assert!(!out.iter().any(|byte| matches!(byte, b'<' | b'>' | b'"')));
        }
    }
}
