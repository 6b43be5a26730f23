// Groups repeated events into one line with a count.

/** @typedef {{ key: string, count: number, first_s: number, at_s: number }} Group */

/** Number of recent lines in which a repeated event is searched; older lines keep their place. */
const LOOK_BACK = 8;

/** Count that the runtime adds to repeated messages. Other numbers of such a message vary, too. */
const COUNT = /\(\d+ so far\)/;

export class EventGroups {
  constructor() {
    /** Newest lines, oldest first. @type {Group[]} */
    this.newest = [];
  }

  /**
   * Returns the line of an event: a new one, or the existing one, which becomes the newest.
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
