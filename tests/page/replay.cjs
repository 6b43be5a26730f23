// A recorded server: serves the page's own files, and sends the recorded messages and answers of a real server. Its
// clock stands still between two calls of `to`, so that no test depends on timing; in between, it repeats the newest
// state.
//
// A recording consists of lines of JSON, ordered by time, after a first line that describes it:
//
//   {"t_ms": 12, "vehicle": "wasp", "message": {"type": "state", ...}}           a text message of the WebSocket
//   {"t_ms": 12, "vehicle": "wasp", "image": [0, 0], "jpeg": "..."}              a binary one: kind, camera, JPEG (base64)
//   {"t_ms": 12, "get": "/api/vehicles", "status": 200, "kind": "...", "json": ...}   an answer (or "text", "base64", "left_out")
//   {"t_ms": 12, "get": "/api/lab", "viewer": "team", ...}                        as another viewer receives it
//   {"t_ms": 12, "order": "POST /api/estop", "status": 200, "kind": "...", "text": ...}
//   {"t_ms": 12, "mark": "flying"}                                               a name for this moment

const fs = require("node:fs");
const http = require("node:http");
const path = require("node:path");
const { WebSocketServer } = require("ws");

const PAGE = path.join(__dirname, "../../render-server/server/src/web/page");
const RECORDINGS = path.join(__dirname, "recordings");
/** Paths that are served under another name, as in `web/routes.rs`. */
const DOCUMENTS = { "/": "/index.html", "/wall": "/wall.html", "/lab": "/lab.html" };
/** Content types of files, as in `build.rs` and `web/routes.rs`. */
const KINDS = {
  ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".svg": "image/svg+xml",
};
/** Headers, as in `web/http.rs`; the test `files` compares them with those of the real server. */
const GUARDS = {
  "content-security-policy":
    "default-src 'self'; img-src 'self' blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
  "x-frame-options": "DENY",
  "x-content-type-options": "nosniff",
  "referrer-policy": "no-referrer",
  "cache-control": "no-cache",
};
/** Header with the recorded viewer that a page plays. */
const VIEWER = "x-recorded-viewer";
/** Interval at which the newest state is repeated, as by a real server. [ms] */
const STATE_EVERY_MS = 100;
/** Close code: the server restarts (RFC 6455, IANA's registry). */
const RESTART = 1012;

/** Returns a file of the page as it is served, or null. */
function pageFile(url) {
  const name = DOCUMENTS[url] ?? url, kind = KINDS[path.extname(name)];
  const file = path.join(PAGE, name);
  const isDocument = Object.values(DOCUMENTS).includes(url);
  if (!kind || isDocument || !file.startsWith(PAGE + path.sep) || !fs.existsSync(file)) return null;
  return { body: fs.readFileSync(file), headers: { "content-type": kind, ...GUARDS } };
}

/** Returns the paths of all files of the page. */
function pagePaths() {
  const files = fs.readdirSync(PAGE, { recursive: true }).map((file) => `/${file.split(path.sep).join("/")}`);
  const renamed = (file) => Object.keys(DOCUMENTS).find((url) => DOCUMENTS[url] === file) ?? file;
  return files.filter((file) => KINDS[path.extname(file)]).map(renamed);
}

const recordingFile = (name) => path.join(RECORDINGS, `${name}.jsonl`);

/** Reads a recording: its description and its records. */
function readRecording(name) {
  const [about, ...records] = fs.readFileSync(recordingFile(name), "utf8").trimEnd().split("\n").map((line) => JSON.parse(line));
  return { about, records };
}

/** Returns the bytes of a recorded answer. */
function body({ json, text, base64 }) {
  if (json !== undefined) return Buffer.from(JSON.stringify(json));
  return base64 === undefined ? Buffer.from(text ?? "") : Buffer.from(base64, "base64");
}

class Replay {
  constructor(name) {
    this.records = readRecording(name).records;
    /** Number of records that have happened. */
    this.now = 0;
    /** Number of records whose answers are available: an order takes effect at once. */
    this.readable = 0;
    /** Open sockets, with the vehicle of each. @type {Map<import("ws").WebSocket, string>} */
    this.sockets = new Map();
    /** Number of answers to each order. */
    this.answered = new Map();
    /** Requests without a recorded answer. */
    this.unknown = [];
    this.vehicles = [...new Set(this.records.filter(({ message }) => message).map(({ vehicle }) => vehicle))];
    this.server = http.createServer((request, response) => this.answer(request, response));
    this.upgrades = new WebSocketServer({ noServer: true });
    this.server.on("upgrade", (request, socket, head) => {
      const vehicle = new URL(request.url, "http://x").searchParams.get("vehicle") ?? this.vehicles[0];
      if (!this.vehicles.includes(vehicle)) return socket.end("HTTP/1.1 404 Not Found\r\nconnection: close\r\n\r\n");
      this.upgrades.handleUpgrade(request, socket, head, (opened) => this.welcome(opened, vehicle));
    });
  }

  /** Starts a server at the moment `mark`, or at the beginning. */
  static async start(name, { port = 0, mark } = {}) {
    const replay = new Replay(name);
    if (mark) await replay.to(mark);
    await new Promise((done, fail) => replay.server.once("error", fail).listen(port, "127.0.0.1", done));
    replay.repeating = setInterval(() => replay.repeat(), STATE_EVERY_MS);
    return replay;
  }

  get url() {
    return `http://127.0.0.1:${this.server.address().port}`;
  }

  /** Advances to the moment `mark`; connected pages receive all messages up to it. */
  async to(mark) {
    const end = this.records.findIndex((record, k) => k >= this.now && record.mark === mark);
    if (end < 0) throw new Error(`the recording has no mark '${mark}'; record it again (tests/page/run --record)`);
    for (; this.now <= end; this.now++) for (const [socket, vehicle] of this.sockets) this.send(socket, vehicle, this.records[this.now]);
  }

  /** Sends the newest state again. */
  repeat() {
    for (const [socket, vehicle] of this.sockets) {
      const state = this.records.slice(0, this.now).findLast((record) => record.vehicle === vehicle && record.message?.type === "state");
      if (state) this.send(socket, vehicle, state);
    }
  }

  /** Ends like the real server: closes with a reason, and rejects new connections. */
  async end() {
    clearInterval(this.repeating);
    for (const socket of this.sockets.keys()) socket.close(RESTART, "the server ends or changes its scene");
    this.sockets.clear();
    const closed = new Promise((done) => this.server.close(done));
    this.server.closeAllConnections();
    await closed;
  }

  /** Sends the messages so far to a page that has just connected. */
  welcome(socket, vehicle) {
    this.sockets.set(socket, vehicle);
    socket.on("close", () => this.sockets.delete(socket));
    const past = this.records.slice(0, this.now);
    const arena = past.findLastIndex((record) => record.vehicle === vehicle && record.message?.type === "arena");
    for (const record of past.slice(Math.max(0, arena))) this.send(socket, vehicle, record);
  }

  send(socket, vehicle, record) {
    if (record.vehicle !== vehicle) return;
    if (record.message) socket.send(JSON.stringify(record.message));
    else if (record.image) socket.send(Buffer.concat([Buffer.from(record.image), Buffer.from(record.jpeg, "base64")]));
  }

  answer(request, response) {
    request.resume();
    const { pathname } = new URL(request.url, "http://x");
    const file = request.method === "GET" && pageFile(pathname);
    if (file) return response.writeHead(200, { ...file.headers, "content-length": file.body.length }).end(file.body);
    const found = request.method === "GET" ? this.read(request.url, pathname, request.headers[VIEWER]) : this.order(`${request.method} ${pathname}`);
    if (!found || found.left_out) {
      if (!found) this.unknown.push(`${request.method} ${request.url}`);
      // A left-out answer never arrives; an image that never arrives would delay the page's other requests.
      else if (!found.kind?.startsWith("image/")) return;
      return response.writeHead(404, GUARDS).end("the recording has no answer to this");
    }
    const bytes = body(found);
    response.writeHead(found.status, { ...GUARDS, ...(found.kind && { "content-type": found.kind }), "content-length": bytes.length }).end(bytes);
  }

  /** Returns the newest answer to a request; before the first one, the first. */
  read(url, pathname, viewer) {
    const until = Math.max(this.now, this.readable);
    for (const isIt of [(get) => get === url, (get) => get?.split("?")[0] === pathname]) {
      const answers = this.records.map((record, k) => [record, k]).filter(([record]) => isIt(record.get) && record.viewer === viewer);
      const [found] = answers.findLast(([, k]) => k < until) ?? answers[0] ?? [];
      if (found) return found;
    }
    return null;
  }

  /** Returns the answer to an order: the next one each time, and finally the last again. */
  order(order) {
    const answers = this.records.filter((record) => record.order === order), count = this.answered.get(order) ?? 0;
    this.answered.set(order, count + 1);
    const answer = answers[Math.min(count, answers.length - 1)], from = this.records.indexOf(answer);
    if (answer) this.readable = Math.max(this.readable, this.records.findIndex(({ mark }, k) => mark && k > from) + 1);
    return answer;
  }
}

module.exports = { Replay, VIEWER, pageFile, pagePaths, readRecording, recordingFile };
