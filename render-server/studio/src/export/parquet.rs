//! Tables as Parquet files: one row group, one page per column, plain and uncompressed.
//!
//! Follows the specification of the format (github.com/apache/parquet-format: README, Encodings.md "PLAIN",
//! parquet.thrift) and of Thrift's compact protocol. Implemented here because crates that write Parquet have about
//! sixty dependencies, and the tables of a flight only need three types.

use super::columns::{Table, Values};

/// Marker at the beginning and the end of a file.
const MAGIC: &[u8] = b"PAR1";

/// Returns the bytes of the file of a table.
pub(super) fn encode(table: &Table) -> Vec<u8> {
    let mut file = MAGIC.to_vec();
    let mut chunks = Vec::new();
    for (_, values) in &table.columns {
        let at = file.len();
        let page = plain(values);
        file.extend(page_header(page.len(), table.rows()));
        file.extend(page);
        chunks.push((at, file.len() - at));
    }
    let footer = footer(table, &chunks);
    let length = footer.len() as u32;
    file.extend(footer);
    file.extend(length.to_le_bytes());
    file.extend(MAGIC);
    file
}

/// Returns values in PLAIN encoding: little-endian, texts prefixed with their length.
fn plain(values: &Values) -> Vec<u8> {
    match values {
        Values::Integers(values) => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        Values::Numbers(values) => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        Values::Texts(values) => {
            let mut bytes = Vec::new();
            for text in values {
                bytes.extend((text.len() as u32).to_le_bytes());
                bytes.extend(text.as_bytes());
            }
            bytes
        }
    }
}

// Constants of parquet.thrift.
const INT64: i64 = 2;
const DOUBLE: i64 = 5;
const BYTE_ARRAY: i64 = 6;
const REQUIRED: i64 = 0;
const UTF8: i64 = 0;
const PLAIN: i64 = 0;
const RLE: i64 = 3;
const UNCOMPRESSED: i64 = 0;
const DATA_PAGE: i64 = 0;

/// Writer of Thrift's compact protocol: field numbers as differences, integers in zigzag encoding.
#[derive(Debug, Default)]
struct Thrift {
    bytes: Vec<u8>,
    /// Number of the previous field of each open structure.
    fields: Vec<i16>,
}

const TYPE_I32: u8 = 5;
const TYPE_I64: u8 = 6;
const TYPE_BINARY: u8 = 8;
const TYPE_LIST: u8 = 9;
const TYPE_STRUCT: u8 = 12;

impl Thrift {
    fn begin(&mut self) {
        self.fields.push(0);
    }

    fn end(&mut self) {
        self.bytes.push(0);
        self.fields.pop();
    }

    /// Writes a field header. Numbers within a structure must increase by less than 16.
    fn field(&mut self, number: i16, kind: u8) {
        if let Some(before) = self.fields.last_mut() {
            self.bytes.push(((number - *before) as u8) << 4 | kind);
            *before = number;
        }
    }

    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.bytes.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.bytes.push(value as u8);
    }

    fn zigzag(&mut self, value: i64) {
        self.varint(((value << 1) ^ (value >> 63)).cast_unsigned());
    }

    fn i32(&mut self, number: i16, value: i64) {
        self.field(number, TYPE_I32);
        self.zigzag(value);
    }

    fn i64(&mut self, number: i16, value: i64) {
        self.field(number, TYPE_I64);
        self.zigzag(value);
    }

    fn text(&mut self, number: i16, text: &str) {
        self.field(number, TYPE_BINARY);
        self.bare_text(text);
    }

    fn bare_text(&mut self, text: &str) {
        self.varint(text.len() as u64);
        self.bytes.extend(text.as_bytes());
    }

    fn list(&mut self, number: i16, kind: u8, len: usize) {
        self.field(number, TYPE_LIST);
        if len < 15 {
            self.bytes.push((len as u8) << 4 | kind);
        } else {
            self.bytes.push(0xf0 | kind);
            self.varint(len as u64);
        }
    }
}

fn page_header(len: usize, rows: usize) -> Vec<u8> {
    let mut thrift = Thrift::default();
    thrift.begin();
    thrift.i32(1, DATA_PAGE);
    thrift.i32(2, len as i64);
    thrift.i32(3, len as i64);
    thrift.field(5, TYPE_STRUCT);
    thrift.begin();
    thrift.i32(1, rows as i64);
    thrift.i32(2, PLAIN);
    // Encodings of levels, which required columns do not have.
    thrift.i32(3, RLE);
    thrift.i32(4, RLE);
    thrift.end();
    thrift.end();
    thrift.bytes
}

fn kind(values: &Values) -> i64 {
    match values {
        Values::Integers(_) => INT64,
        Values::Numbers(_) => DOUBLE,
        Values::Texts(_) => BYTE_ARRAY,
    }
}

fn footer(table: &Table, chunks: &[(usize, usize)]) -> Vec<u8> {
    let rows = table.rows() as i64;
    let mut thrift = Thrift::default();
    thrift.begin();
    thrift.i32(1, 1);
    thrift.list(2, TYPE_STRUCT, 1 + table.columns.len());
    thrift.begin();
    thrift.text(4, "schema");
    thrift.i32(5, table.columns.len() as i64);
    thrift.end();
    for (name, values) in &table.columns {
        thrift.begin();
        thrift.i32(1, kind(values));
        thrift.i32(3, REQUIRED);
        thrift.text(4, name);
        if matches!(values, Values::Texts(_)) {
            thrift.i32(6, UTF8);
        }
        thrift.end();
    }
    thrift.i64(3, rows);
    thrift.list(4, TYPE_STRUCT, 1);
    thrift.begin();
    thrift.list(1, TYPE_STRUCT, chunks.len());
    for ((name, values), &(at, len)) in table.columns.iter().zip(chunks) {
        thrift.begin();
        thrift.i64(2, at as i64);
        thrift.field(3, TYPE_STRUCT);
        thrift.begin();
        thrift.i32(1, kind(values));
        thrift.list(2, TYPE_I32, 1);
        thrift.zigzag(PLAIN);
        thrift.list(3, TYPE_BINARY, 1);
        thrift.bare_text(name);
        thrift.i32(4, UNCOMPRESSED);
        thrift.i64(5, rows);
        thrift.i64(6, len as i64);
        thrift.i64(7, len as i64);
        thrift.i64(9, at as i64);
        thrift.end();
        thrift.end();
    }
    thrift.i64(2, chunks.iter().map(|(_, len)| *len as i64).sum());
    thrift.i64(3, rows);
    thrift.end();
    thrift.text(6, concat!("vizflyt ", env!("CARGO_PKG_VERSION")));
    thrift.end();
    thrift.bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Checks the bytes; `tests/pose` reads complete tables with pyarrow.
    #[test]
    fn writes_the_framing_of_the_format() {
        let mut table = Table::default();
        table.integers("a", [1, 2, 3].into_iter());
        table.texts("b", ["x", "", "long"].map(str::to_owned).into_iter());
        let file = encode(&table);
        assert_eq!((&file[..4], &file[file.len() - 4..]), (MAGIC, MAGIC));
        let len = u32::from_le_bytes(*file[file.len() - 8..].first_chunk().unwrap()) as usize;
        let footer = &file[file.len() - 8 - len..file.len() - 8];
        // Version 1; three elements of the schema.
        assert_eq!(footer[..4], [0x15, 2, 0x19, 0x3c]);
        assert_eq!(*footer.last().unwrap(), 0);
        let mut thrift = Thrift::default();
        thrift.zigzag(-1);
        thrift.varint(300);
        assert_eq!(thrift.bytes, [1, 0xac, 2]);
    }
}
