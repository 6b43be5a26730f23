// The program under test as child processes.

const assert = require("node:assert/strict");
const { spawn, spawnSync } = require("node:child_process");
const { once } = require("node:events");
const path = require("node:path");

/** Timeout of a failing test; a passing one waits for an event. [ms] */
const PATIENCE_MS = 120_000;

class Program {
  /** @param {string} vizflyt path of the program */
  constructor(vizflyt) {
    this.vizflyt = vizflyt;
    this.children = [];
  }

  /** Path of the example plugin that fails in the selected way. */
  get misbehave() {
    return path.join(path.dirname(this.vizflyt), "examples", "misbehave");
  }

  /** Starts the program; `line` waits for a line of its standard output. */
  start(...args) {
    const child = spawn(this.vizflyt, args, { stdio: ["pipe", "pipe", "inherit"] });
    this.children.push(child);
    const lines = [], waiting = new Set();
    let rest = "";
    child.stdout.on("data", (bytes) => {
      const parts = (rest + bytes).split(/\r?\n|\r/);
      rest = parts.pop();
      lines.push(...parts);
      for (const look of waiting) look();
    });
    const ended = new Promise((done) => child.on("exit", done));
    const line = (pattern) =>
      new Promise((done, fail) => {
        const give_up = (why) => fail(new Error(`${why}: no line ${pattern} in:\n${lines.join("\n")}`));
        const timer = setTimeout(give_up, PATIENCE_MS, `after ${PATIENCE_MS / 1000} s`);
        const look = () => {
          const found = lines.map((text) => text.match(pattern)).find(Boolean);
          if (!found) return;
          clearTimeout(timer);
          waiting.delete(look);
          done(found);
        };
        waiting.add(look);
        look();
        ended.then((status) => {
          clearTimeout(timer);
          if (waiting.has(look)) give_up(`the program has ended with status ${status}`);
        });
      });
    return { child, line, ended };
  }

  /** Runs a command to its end; returns its output. */
  command(...args) {
    const { status, stdout, stderr } = this.run(...args);
    assert.equal(status, 0, `vizflyt ${args.join(" ")}: ${stderr}`);
    return stdout;
  }

  /** Runs a command to its end, with any exit status. */
  run(...args) {
    return spawnSync(this.vizflyt, args, { encoding: "utf8" });
  }

  /** Kills all running processes, and waits until they have ended. */
  async kill() {
    for (const child of this.children.splice(0)) {
      // A process that could not be started does not end.
      if (!child.pid || child.exitCode !== null || child.signalCode !== null) continue;
      const ended = once(child, "exit");
      child.kill("SIGKILL");
      await ended;
    }
  }
}

module.exports = { PATIENCE_MS, Program };
