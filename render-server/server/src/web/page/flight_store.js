// The last flights that this browser has watched, stored in the browser. They can be replayed after the program has
// ended or restarted. Without storage, the list is empty.

/** @typedef {import("./flight_file.js").About} About */
/** A stored flight: its number and description. @typedef {About & { key: number }} Kept */

const NAME = "vizflyt-flights", TABLE = "flights";
/** Maximum number of flights of each arena. */
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
 * Executes a request on the table; resolves with its result when it is stored.
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

/** Returns the stored flights of an arena, newest first. @param {string} arena @returns {Promise<Kept[]>} */
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

/** Stores a flight's file, and deletes the oldest of its arena. @param {About} about @param {string} text */
export async function keepFlight(about, text) {
  try {
    await ask("readwrite", (table) => table.add({ about, text }));
    for (const { key } of (await keptFlights(about.arena)).slice(MOST)) await ask("readwrite", (table) => table.delete(key));
  } catch {
    // The browser has no storage, or it is full.
  }
}

/** Returns the file of a stored flight. @param {number} key @returns {Promise<string>} */
export async function flightText(key) {
  return (await ask("readonly", (table) => table.get(key))).text;
}
