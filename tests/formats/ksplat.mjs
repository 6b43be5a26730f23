// node ksplat.mjs NODE_MODULES write IN.ply OUT.ksplat LEVEL DEGREE
// node ksplat.mjs NODE_MODULES read IN.ksplat OUT.json
// Uses the viewer's own library, like its converter.
import { readFileSync, writeFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [modules, verb, input, output, level, degree] = process.argv.slice(2);
// The library needs a browser's window when it is loaded.
globalThis.window ??= globalThis;
globalThis.navigator ??= { userAgent: '' };
const at = (name) => pathToFileURL(`${modules}/${name}`).href;
const { PlyParser, SplatBuffer, SplatBufferGenerator } = await import(
    at('@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js')
);
const file = readFileSync(input);
const bytes = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
if (verb === 'write') {
    const splats = PlyParser.parseToUncompressedSplatArray(bytes, Number(degree));
    // Opacity below this byte is removed; 0 keeps everything.
    const generator = SplatBufferGenerator.getStandardGenerator(0, Number(level));
    const buffer = generator.generateFromUncompressedSplatArray(splats).bufferData;
    writeFileSync(output, Buffer.from(buffer));
} else {
    const three = await import(at('three/build/three.module.js'));
    const buffer = new SplatBuffer(bytes);
    const splats = [];
    for (let i = 0; i < buffer.getSplatCount(); i++) {
        const [centre, scale] = [new three.Vector3(), new three.Vector3()];
        const [turn, colour] = [new three.Quaternion(), new three.Vector4()];
        buffer.getSplatCenter(i, centre);
        buffer.getSplatScaleAndRotation(i, scale, turn);
        buffer.getSplatColor(i, colour);
        splats.push([
            ...centre.toArray(), ...scale.toArray(), turn.w, turn.x, turn.y, turn.z, ...colour.toArray(),
        ]);
    }
    writeFileSync(output, JSON.stringify(splats));
}
