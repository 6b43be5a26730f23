//! The server as its peers meet it: runtimes, browsers and strangers over real sockets on loopback. One program, because each
//! one links the whole server.

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
