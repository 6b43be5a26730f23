// All tests of the page in one process, which share a browser. Arguments: see `harness.cjs`.

const fs = require("node:fs");
const path = require("node:path");

const folder = path.join(__dirname, "tests");
for (const file of fs.readdirSync(folder).sort()) if (file.endsWith(".cjs")) require(path.join(folder, file));
