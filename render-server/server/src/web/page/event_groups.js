// Events that come again and again are one line: which events are the same, and how often they came.

/** @typedef {{ key: string, count: number, first_s: number, at_s: number }} Group */

/** An event is the same as one of so many lines before it; older ones are left where they stand. */
const LOOK_BACK = 8;

/** A count, as the runtime adds it to what comes often; the other numbers of such a sentence are others each time, too. */
const COUNT = /\(\d+ so far\)/;

export class EventGroups {
  constructor() {
    /** The newest lines, oldest first. @type {Group[]} */
    this.newest = [];
  }

  /**
   * Returns the line of an event: a new one, or one that has come before, which is the newest from now on.
   * @param {string} tone
   * @param {string} sentence
   * @param {number} at_s since the server's start
   */
  add(tone, sentence, at_s) {
    const key = `${tone}\n${COUNT.test(sentence) ? sentence.replaceAll(/\d+/g, "#") : sentence}`;
    const found = this.newest.findIndex((group) => group.key === key);
    /** @type {Group} */
    const group = found < 0 ? { key, count: 0, first_s: at_s, at_s } : this.newest.splice(found, 1)[0];
    group.count += 1;
    group.at_s = at_s;
    this.newest.push(group);
    if (this.newest.length > LOOK_BACK) this.newest.shift();
    return group;
  }
}
