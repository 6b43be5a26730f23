// The leaderboard: fetches the standings, and makes table rows for the page and the wall.

import { make } from "./dom.js";

/** @typedef {import("./messages").Leaderboard} Leaderboard */

/**
 * Fetches the standings; null if no leaderboard is configured, or the viewer may not see it.
 * @returns {Promise<Leaderboard | null>}
 */
export async function fetchLeaderboard() {
  const answer = await fetch("/api/leaderboard");
  return answer.ok ? answer.json() : null;
}

/** @param {(string | number)[]} texts */
const makeRow = (...texts) => make("tr", {}, ...texts.map((text) => make("td", { textContent: String(text) })));
/** @param {number | null} s */
const seconds = (s) => (s == null ? "–" : `${s.toFixed(2)} s`);

/**
 * Fills a table's body with ranks.
 * @param {HTMLElement} body
 * @param {Leaderboard["official"]} places
 */
export function fillPlaces(body, places) {
  const rows = places.map(({ rank, team, stages_passed, stages, seconds: s }) => {
    const row = makeRow(rank, team, `${stages_passed}/${stages}`, seconds(s));
    row.className = rank === 1 ? "first" : "";
    return row;
  });
  if (!rows.length) rows.push(make("tr", { className: "none" }, make("td", { textContent: "nobody yet", colSpan: 4 })));
  body.replaceChildren(...rows);
}

/**
 * Fills a node with the standings of signed grades: a table for each course and its conditions.
 * @param {HTMLElement} node
 * @param {Leaderboard["graded"]} boards
 */
export function fillGrades(node, boards) {
  const parts = boards.flatMap(({ project, level, conditions, places }) => {
    const rows = places.map(({ rank, team, mean_stages_passed, stages, finished, flights, median_s }) => {
      const row = makeRow(rank, team, `${mean_stages_passed.toFixed(2)}/${stages}`, `${finished} of ${flights}`, seconds(median_s));
      row.className = rank === 1 ? "first" : "";
      return row;
    });
    const heads = ["place", "team", "stages", "finished", "time"].map((textContent) => make("th", { textContent, scope: "col" }));
    const title = make("h3", { textContent: `graded: ${project} ${level}, ${conditions}` });
    return [title, make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...rows))];
  });
  node.replaceChildren(...parts);
}
