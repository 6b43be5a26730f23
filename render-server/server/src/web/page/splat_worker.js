// Worker that fetches a twin's parts and sorts its splats, in parallel to the page's thread.
// In: { parts, boot } once; then { ahead }, the camera's direction. Out: { texels } after each part, { order } for each
// `ahead`.

import { backToFront, readSpz } from "./splats.js";

let texels = new Float32Array();

/** @param {string} url */
async function fetchPart(url) {
  const answer = await fetch(url);
  if (!answer.ok || !answer.body) throw new Error(await answer.text());
  return new Response(answer.body.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

/**
 * @param {number} parts
 * @param {string} boot
 */
async function fetchParts(parts, boot) {
  for (let part = 0; part < parts; part++) {
    const more = readSpz(await fetchPart(`/api/splats/${part}?${boot}`));
    const all = new Float32Array(texels.length + more.length);
    all.set(texels);
    all.set(more, texels.length);
    texels = all;
    postMessage({ texels });
  }
}

addEventListener("message", ({ data }) => {
  // A failure becomes an error of the worker, and the view keeps its boxes.
  if (data.parts) fetchParts(data.parts, data.boot).catch((error) => setTimeout(() => { throw error; }));
  else {
    const order = backToFront(texels, data.ahead);
    postMessage({ order }, { transfer: [order.buffer] });
  }
});
