// Frames of films: one request at a time, of several requests the last one wins; the next frames are read ahead while playing.

const MAX_KEPT = 24, MAX_KEPT_PIXELS = 6e6; // pictures that are kept; each pixel takes four bytes
const AHEAD = 6;

const keyOf = (film, number) => `${film.run ?? film.file}|${film.version ?? ""}|${number}`;

export class FilmFrames {
  /** `arrived(picture, film, number)` is called for the frame that was asked for last; `failed(error)` if it cannot be read. */
  constructor(fetch, arrived, failed) {
    Object.assign(this, { fetch, arrived, failed, kept: new Map(), pixels: 0, busy: false, wanted: null, ahead: 0, closed: false });
  }

  ask(film, number, ahead = 0) {
    this.ahead = ahead; // direction of playing: 1, or 0 while it rests
    const picture = this.kept.get(keyOf(film, number));
    this.wanted = picture ? null : { film, number };
    this.last = { film, number };
    if (picture) {
      this.touch(keyOf(film, number), picture);
      this.arrived(picture, film, number);
    }
    this.work();
  }

  async work() {
    if (this.busy || this.closed) return;
    const job = this.wanted || this.nextAhead();
    if (!job) return;
    this.busy = true;
    try {
      const picture = await this.fetch(job.film, job.number);
      if (this.closed) return picture.close();
      const key = keyOf(job.film, job.number);
      this.keep(key, picture);
      if (this.wanted && keyOf(this.wanted.film, this.wanted.number) === key) this.wanted = null;
      // a late frame is shown while a newer one is under way, so that the picture moves while the mouse moves
      const isLast = keyOf(this.last.film, this.last.number) === key;
      if (isLast || (this.wanted && !job.isAhead)) this.arrived(picture, job.film, job.number);
    } catch (error) {
      this.ahead = 0;
      if (this.wanted?.number === job.number) this.wanted = null;
      if (!this.closed) this.failed(error);
    } finally {
      this.busy = false;
    }
    this.work();
  }

  nextAhead() {
    const { film, number } = this.last || {};
    for (let k = 1; this.ahead && k <= AHEAD; k++) {
      const n = (number + k * this.ahead) % film.frames;
      if (!this.kept.has(keyOf(film, n))) return { film, number: n, isAhead: true };
    }
    return null;
  }

  touch(key, picture) {
    this.kept.delete(key);
    this.kept.set(key, picture);
  }

  /** The picture that was used longest ago is closed first: its memory is freed at once. */
  keep(key, picture) {
    this.kept.set(key, picture);
    this.pixels += picture.width * picture.height;
    for (const [old, other] of this.kept) {
      if (this.kept.size <= 2 || (this.kept.size <= MAX_KEPT && this.pixels <= MAX_KEPT_PIXELS)) break;
      this.kept.delete(old);
      this.pixels -= other.width * other.height;
      other.close();
    }
  }

  destroy() {
    this.closed = true;
    for (const picture of this.kept.values()) picture.close();
    this.kept.clear();
  }
}
