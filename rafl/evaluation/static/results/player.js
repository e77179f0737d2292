// Time: the frame that is shown, and playing in slow motion.

export class Player {
  // `show` is called with every new frame; `changed` when playing starts or stops.
  constructor(show, changed) {
    Object.assign(this, { show, changed, time: [0], frame: 0, speed: 0.25, playing: false, once: null });
  }

  load(time) {
    this.time = time;
    this.go(Math.min(this.frame, time.length - 1));
  }

  get last() {
    return this.time.length - 1;
  }

  go(frame) {
    this.frame = Math.min(Math.max(Math.round(frame), 0), this.last);
    this.clock = this.time[this.frame];
    this.show(this.frame);
  }

  step(count) {
    this.stop();
    this.go(this.frame + count);
  }

  // The frame nearest to a time [s].
  goToTime(time) {
    let nearest = 0;
    this.time.forEach((own, frame) => {
      if (Math.abs(own - time) < Math.abs(this.time[nearest] - time)) nearest = frame;
    });
    this.go(nearest);
  }

  toggle() {
    if (this.playing) this.stop();
    else this.play();
  }

  // Plays over and over; `once` is called instead of the second time.
  play(once = null) {
    if (this.last < 1) {
      once?.();
      return;
    }
    this.once = once;
    this.playing = true;
    this.before = null;
    this.changed();
    requestAnimationFrame((now) => this.tick(now));
  }

  stop() {
    if (!this.playing) return;
    this.playing = false;
    this.once = null;
    this.changed();
  }

  tick(now) {
    if (!this.playing) return;
    if (this.before !== null) this.clock += (this.speed * (now - this.before)) / 1000;
    this.before = now;
    const end = this.time[this.last] + (this.time[this.last] - this.time[this.last - 1]);
    if (this.clock >= end) {
      const once = this.once;
      if (once) {
        this.stop();
        once();
        return;
      }
      this.clock = this.time[0];
    }
    let frame = this.clock < this.time[this.frame] ? 0 : this.frame;
    while (frame < this.last && this.time[frame + 1] <= this.clock) frame++;
    if (frame !== this.frame) {
      this.frame = frame;
      this.show(frame);
    }
    requestAnimationFrame((next) => this.tick(next));
  }
}
