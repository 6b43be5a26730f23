// node spz.mjs NODE_MODULES IN.ply OUT.spz, or IN.spz OUT.ply: converts with spz-js.
import { createReadStream, readFileSync, writeFileSync } from 'node:fs';
import { Readable } from 'node:stream';
import { pathToFileURL } from 'node:url';

const [modules, input, output] = process.argv.slice(2);
const { loadPly, loadSpz, serializePly, serializeSpz } = await import(
    pathToFileURL(`${modules}/spz-js/dist/index.js`).href
);
const scene = input.endsWith('.spz')
    ? await loadSpz(readFileSync(input))
    : await loadPly(Readable.toWeb(createReadStream(input)));
const bytes = output.endsWith('.spz') ? await serializeSpz(scene) : await serializePly(scene);
writeFileSync(output, Buffer.from(bytes));
