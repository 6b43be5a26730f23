// Reports the tests as TAP, and lists failed ones again before the counts, so that they are at the end of the log.

const { tap } = require("node:test/reporters");

/** Maximum listed lines of an error; the test itself prints all. */
const MAX_LINES = 14;

/** Returns the name and error of a failed test, as lines. */
function listed({ name, details: { error } }) {
  const cause = error?.cause ?? error;
  const lines = `${cause?.stack ?? cause}`.split("\n").filter((line) => line.trim());
  return [`failed: ${name}`, ...lines.slice(0, MAX_LINES), ...(cause?.explanation ?? [])].map((line) => line.slice(0, 400));
}

/** Adds the list of failed tests to the runner's events. */
async function* withList(events) {
  const failed = [];
  for await (const event of events) {
    const { type, data } = event;
    if (type === "test:fail") failed.push(data);
    if (type === "test:diagnostic" && data.nesting === 0 && /^tests \d+$/.test(data.message))
      for (const message of failed.flatMap(listed)) yield { type, data: { nesting: 0, message } };
    yield event;
  }
}

module.exports = (events) => tap(withList(events));
