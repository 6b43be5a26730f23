//! Tests of the server through real sockets on loopback, as runtimes, browsers and strangers. All are in one program,
//! because each program links the complete server.

mod access;
mod arrows;
mod crash;
mod handshakes;
mod https;
mod lab;
mod leaderboard;
mod many;
mod meeting;
mod page;
mod pairing;
mod rights;
mod slices;
mod stream;
mod support;
mod viewers;
