// Records the data that a real server sends to a page; format: see `replay.cjs`. To keep files small, it records one
// state per second and changed ones, the first images and those at marks, and the last answer before each mark.

const fs = require("node:fs");
const { pageFile, recordingFile } = require("./replay.cjs");

/** Minimum interval of equal states. [ms] */
const STATE_EVERY_MS = 1000;
/** Maximum recorded answer; parts of a twin are longer. [bytes] */
const MAX_ANSWER = 150_000;

class Recorder {
  constructor(name, what, without) {
    this.name = name;
    this.what = what;
    this.without = without;
    this.began = performance.now();
    this.records = [];
    /** Sockets by vehicle: two pages may watch the same one. */
    this.sources = new Map();
    /** Newest state of each vehicle, and newest image by kind and camera, that are not recorded yet. */
    this.pending = new Map();
    /** Last recorded state of each vehicle, and its time. */
    this.states = new Map();
    this.reading = new Set();
    this.isOver = false;
  }

  add(record) {
    if (!this.isOver) this.records.push(record);
    return record;
  }

  get t_ms() {
    return Math.round(performance.now() - this.began);
  }

  /** Records the data that a page receives, as the page of a `viewer` if its answers differ. */
  watch(page, viewer) {
    const own = new Set();
    // Sockets of a page that has navigated do not always report their end.
    page.on("framenavigated", (frame) => {
      if (frame !== page.mainFrame()) return;
      for (const [key, socket] of this.sources) if (own.has(socket)) this.sources.delete(key);
    });
    page.on("websocket", (socket) => {
      const vehicle = new URL(socket.url()).searchParams.get("vehicle");
      const key = vehicle === this.first ? "" : (vehicle ?? "");
      if (this.sources.has(key)) return;
      this.sources.set(key, socket);
      own.add(socket);
      socket.on("close", () => this.sources.get(key) === socket && this.sources.delete(key));
      socket.on("framereceived", ({ payload }) => this.sources.get(key) === socket && this.receive(key, payload));
    });
    page.on("response", (response) => this.read(response, viewer));
  }

  receive(key, payload) {
    if (typeof payload !== "string") {
      const record = { vehicle: this.named(key), image: [...payload.subarray(0, 2)], jpeg: payload.subarray(2).toString("base64") };
      return this.newest(`${key} image ${record.image}`, record);
    }
    const message = JSON.parse(payload);
    if (message.type === "arena" && key === "") this.first = message.vehicle;
    const record = { t_ms: this.t_ms, vehicle: this.named(key), message };
    if (message.type !== "state") return this.add(record);
    const { report, outcome, landed, crash, runtime, flight_s, others } = message;
    const says = JSON.stringify([report?.phase, outcome, landed, crash, runtime, flight_s == null, others.map(({ phase }) => phase)]);
    const last = this.states.get(key);
    if (last?.says === says && record.t_ms < last.t_ms + STATE_EVERY_MS) return this.pending.set(`${key} state`, record);
    this.states.set(key, { says, t_ms: record.t_ms });
    this.pending.delete(`${key} state`);
    this.add(record);
  }

  named(key) {
    return key || this.first;
  }

  /** Records the first of its kind at once, later ones at the next mark. */
  newest(key, record) {
    if (this.pending.has(key)) return this.pending.set(key, record);
    this.pending.set(key, null);
    this.add({ t_ms: this.t_ms, ...record });
  }

  async read(response, viewer) {
    const request = response.request(), url = new URL(response.url());
    const isRead = request.method() === "GET";
    if (!url.protocol.startsWith("http") || (isRead && pageFile(url.pathname))) return;
    const place = isRead ? { get: url.pathname + url.search } : { order: `${request.method()} ${url.pathname}` };
    const kind = response.headers()["content-type"];
    const record = this.add({ t_ms: this.t_ms, ...place, viewer, status: response.status(), kind });
    const reading = response.body().catch(() => null);
    this.reading.add(reading);
    const bytes = await reading;
    this.reading.delete(reading);
    const text = bytes?.toString() ?? "";
    // The page has not read it either.
    if (!bytes) record.is_unread = true;
    else if (bytes.length > MAX_ANSWER || this.without?.test(url.pathname)) record.left_out = bytes.length;
    // Recordings contain no token, not even an expired one.
    else if (kind?.startsWith("application/json")) record.json = JSON.parse(text, (key, value) => (key === "token" && value ? "recorded" : value));
    else if (!kind || kind.startsWith("text/")) record.text = text;
    else record.base64 = bytes.toString("base64");
  }

  /** Names this moment, and records the newest state and images. */
  mark(name) {
    for (const [key, record] of this.pending) {
      if (record) this.add({ t_ms: this.t_ms, ...record });
      this.pending.set(key, null);
      if (key.endsWith(" state")) this.pending.delete(key);
    }
    this.add({ t_ms: this.t_ms, mark: name });
  }

  /** Ends the recording: later data comes from another server. */
  end() {
    this.isOver = true;
  }

  async write() {
    await Promise.all(this.reading);
    // Between two marks, only the last answer to a request counts.
    const later = new Set();
    const isNeeded = ({ mark, get, viewer }) => {
      if (mark) later.clear();
      const key = `${viewer} ${get}`, isLast = !later.has(key);
      if (get) later.add(key);
      return isLast || !get;
    };
    const needed = [...this.records].reverse().filter(isNeeded).reverse();
    const newest = new Map();
    const isNew = ({ t_ms: _, ...answer }) => {
      const key = `${answer.viewer} ${answer.get}`, text = JSON.stringify(answer), isSame = newest.get(key) === text;
      newest.set(key, text);
      return !answer.get || !isSame;
    };
    const kept = needed.filter(isNew);
    const about = { recording: this.what, anew: `tests/page/run --record --only ${this.name} VIZFLYT` };
    const lines = [about, ...kept].map((record) => JSON.stringify(record));
    fs.writeFileSync(recordingFile(this.name), `${lines.join("\n")}\n`);
  }
}

module.exports = { Recorder };
