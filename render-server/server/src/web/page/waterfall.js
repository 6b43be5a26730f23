// The timing panel: where images get their age, stage by stage, how regularly they come, and what
// became of those that did not. Asks once a second, and only while it is open.

const STAGES = {
  pose: "measured, until rendering starts",
  render: "drawing all cameras",
  encode: "waiting for the encoder, and encoding",
  send: "until the first byte is with the runtime",
  receive: "until the last byte is",
  decode: "waiting for the decoder, and decoding",
  handover: "until the plugin starts on it",
  plugin: "inside the plugin",
  setpoint: "until the setpoint leaves for the autopilot",
};
const SUMS = { age: "pose to plugin", total: "pose to setpoint" };
const REASONS = {
  no_room: "newer drawn before there was room to send",
  failed: "not encoded",
  late: "given up on the way",
  stale: "a newer one had come before",
  broken: "did not decode",
  superseded: "a newer one came before the decoder was free",
  unasked: "a newer one was decoded before the plugin asked",
  overrun: "the plugin was still at an earlier one",
};
/** Edges of the jitter's bins, as the runtime counts them. [ms] */
const EDGES = [2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 25, 30, 35, 40, 50, 70, 100, 200, 500];
const PERIOD_MS = 1000;

const make = (tag, name, text) => {
  const node = document.createElement(tag);
  if (name) node.className = name;
  if (text != null) node.textContent = text;
  return node;
};
const ms = (value) => (Number.isFinite(value) ? value.toFixed(value < 9.95 ? 2 : 1) : "–");
const share = (part, whole) => `${(100 * Math.min(1, Math.max(0, part / whole))).toFixed(2)}%`;

export class Waterfall {
  constructor(panel, body) {
    [this.panel, this.body, this.timer] = [panel, body, 0];
    panel.addEventListener("toggle", () => this.tick());
    this.tick();
  }

  async tick() {
    clearTimeout(this.timer);
    if (!this.panel.open) return;
    if (!document.hidden) await this.ask();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.tick(), PERIOD_MS);
  }

  async ask() {
    const vehicle = new URLSearchParams(location.search).get("vehicle");
    const query = vehicle == null ? "" : `?vehicle=${encodeURIComponent(vehicle)}`;
    try {
      const answer = await fetch(`/api/stats${query}`);
      if (answer.ok) this.show(await answer.json());
      else this.say(await answer.text());
    } catch {
      this.say("the server cannot be reached");
    }
  }

  say(text) {
    this.body.replaceChildren(make("p", "muted", text));
  }

  show({ runtime, timing, images, connection }) {
    if (!runtime && !timing) return this.say("no runtime flies: there is nothing to time");
    if (!timing) return this.say("the runtime has not reported yet");
    const parts = [this.table(timing.waterfall), this.jitter(timing.intervals)];
    parts.push(...images.map((camera) => this.account(camera)));
    parts.push(this.facts(timing, connection));
    this.body.replaceChildren(...parts);
  }

  table({ stages, age, total, images }) {
    const sum = Object.keys(STAGES).reduce((ms, name) => ms + stages[name].p50, 0);
    const width = Math.max(sum, total.p99, age.p99, 0.1);
    const table = make("table", "falls"), body = make("tbody");
    const caption = make("caption", "away", `ages by stage of ${images} images`);
    const head = make("thead"), row = make("tr");
    for (const text of ["stage", "", "p50", "p90", "p99", "max"]) row.append(make("th", "", text));
    row.children[5].textContent = "max ms";
    head.append(row);
    let start = 0;
    for (const [name, what] of Object.entries(STAGES)) {
      body.append(this.row(name, what, start, stages[name], width));
      start += stages[name].p50;
    }
    for (const [name, what] of Object.entries(SUMS)) {
      const line = this.row(name, what, 0, { age, total }[name], width);
      line.className = "sum";
      body.append(line);
    }
    table.append(caption, head, body);
    return table;
  }

  /** A stage: the median as a full bar where the stages before it end, then up to the 99th. */
  row(name, what, start, times, width) {
    const line = make("tr"), bar = make("td", "bar"), track = make("div");
    const median = make("i"), rest = make("i", "rest");
    median.style.left = share(start, width);
    median.style.width = share(Math.min(times.p50, width - start), width);
    rest.style.left = share(start + times.p50, width);
    const left = width - start - times.p50;
    rest.style.width = share(Math.min(times.p99 - times.p50, left), width);
    track.append(rest, median);
    bar.append(track);
    const title = make("th", "", name);
    title.scope = "row";
    line.title = what;
    line.append(title, bar, ...["p50", "p90", "p99", "max"].map((key) => make("td", key, ms(times[key]))));
    return line;
  }

  jitter({ times, bins }) {
    const figure = make("figure", "jitter"), bars = make("div");
    const most = Math.max(1, ...bins), count = bins.reduce((sum, n) => sum + n, 0);
    const first = Math.max(0, bins.findIndex((n) => n > 0) - 1);
    const last = Math.min(bins.length - 1, bins.findLastIndex((n) => n > 0) + 1);
    for (let k = first; k <= last && count > 0; k += 1) {
      const column = make("span"), bar = make("i");
      // The square root: a few outliers among hundreds must show.
      bar.style.height = share(Math.sqrt(bins[k]), Math.sqrt(most));
      const from = EDGES[k - 1] ?? 0, to = EDGES[k];
      column.title = `${bins[k]} ${to ? `from ${from} to ${to} ms` : `over ${from} ms`}`;
      column.append(bar, make("small", "", to ?? `${from}+`));
      bars.append(column);
    }
    const text = `between images: p50 ${ms(times.p50)}, p99 ${ms(times.p99)}, max ${ms(times.max)} ms`;
    figure.append(make("figcaption", "", text), bars);
    return figure;
  }

  account({ camera, drawn, delivered, under_way, skipped }) {
    const block = make("div", "account");
    const lost = Object.values(skipped).reduce((sum, n) => sum + n, 0);
    block.append(make("p", "", `${camera}: ${drawn} drawn, ${delivered} delivered, ${lost} skipped, ${under_way} under way`));
    const list = make("ul");
    for (const [name, why] of Object.entries(REASONS))
      if (skipped[name] > 0) {
        const line = make("li");
        line.append(make("b", "", skipped[name]), make("span", "", `${name.replace("_", " ")}: ${why}`));
        list.append(line);
      }
    if (list.childElementCount) block.append(list);
    return block;
  }

  facts({ clock, waterfall }, connection) {
    const list = make("dl", "facts");
    const fact = (name, text) => list.append(make("dt", "", name), make("dd", "", text));
    if (clock) {
      fact("clocks", `known to ${clock.error_bound_ms.toFixed(3)} ms, drift ${clock.drift_ppm.toFixed(1)} ± ${clock.drift_bound_ppm.toFixed(1)} ppm`
        + (waterfall.out_of_bound ? `; ${waterfall.out_of_bound} images out of bound` : ""));
    }
    if (connection) {
      const { rtt_ms, mbit_s, packets_lost, packets_sent, mtu } = connection;
      fact("connection", `round trip ${rtt_ms.toFixed(2)} ms, ${mbit_s.toFixed(1)} Mb/s, ${packets_lost} of ${packets_sent} packets lost, ${mtu} bytes each`);
    }
    return list;
  }
}

const panel = document.getElementById("timing");
if (panel) new Waterfall(panel, document.getElementById("timing-body"));
