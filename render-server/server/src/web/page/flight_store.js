// The last flights that this browser has watched, kept in it: they can be looked at again after the program has ended, or has
// been started anew. Where a browser keeps nothing, there are none.

/** @typedef {import("./flight_file.js").About} About */
/** A kept flight: its number and what is said of it. @typedef {About & { key: number }} Kept */

const NAME = "vizflyt-flights", TABLE = "flights";
/** Of each arena. */
const MOST = 12;

/** @type {Promise<IDBDatabase> | null} */
let opened = null;

function open() {
  opened ??= new Promise((done, fail) => {
    const request = indexedDB.open(NAME, 1);
    request.onupgradeneeded = () => request.result.createObjectStore(TABLE, { autoIncrement: true });
    request.onsuccess = () => done(request.result);
    request.onerror = () => fail(request.error);
  });
  return opened;
}

/**
 * Does something with the table; resolves with its result once that is kept.
 * @template T
 * @param {"readonly" | "readwrite"} mode
 * @param {(table: IDBObjectStore) => IDBRequest<T>} act
 * @returns {Promise<T>}
 */
async function ask(mode, act) {
  const transaction = (await open()).transaction(TABLE, mode);
  const request = act(transaction.objectStore(TABLE));
  return new Promise((done, fail) => {
    transaction.oncomplete = () => done(request.result);
    transaction.onerror = transaction.onabort = () => fail(transaction.error);
  });
}

/** Returns the kept flights of an arena, the newest first. @param {string} arena @returns {Promise<Kept[]>} */
export async function keptFlights(arena) {
  try {
    const keys = await ask("readonly", (table) => table.getAllKeys());
    const all = await ask("readonly", (table) => table.getAll());
    const kept = all.map(({ about }, k) => ({ ...about, key: /** @type {number} */ (keys[k]) }));
    return kept.filter((one) => one.arena === arena).toReversed();
  } catch {
    return [];
  }
}

/** Keeps a flight's file, and forgets the oldest of its arena. @param {About} about @param {string} text */
export async function keepFlight(about, text) {
  try {
    await ask("readwrite", (table) => table.add({ about, text }));
    for (const { key } of (await keptFlights(about.arena)).slice(MOST)) await ask("readwrite", (table) => table.delete(key));
  } catch {
    // A browser that keeps nothing, or has no room.
  }
}

/** Returns the file of a kept flight. @param {number} key @returns {Promise<string>} */
export async function flightText(key) {
  return (await ask("readonly", (table) => table.get(key))).text;
}
