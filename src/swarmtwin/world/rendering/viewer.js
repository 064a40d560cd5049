"use strict";

// Poses of one play: x_mm, y_mm and heading_rad of every vehicle at every moment, one after the other.
function decoded(play, vehicles) {
  const columns = 3 * vehicles, poses = new Float64Array(play.moves.length);
  const sums = new Array(columns).fill(0), units = [0.1, 0.1, 0.001];
  play.moves.forEach((move, index) => {
    const column = index % columns;
    sums[column] += move;
    poses[index] = sums[column] * units[column % 3];
  });
  return { ...play, vehicles, poses, periods: play.legs.length - 1 };
}

// Between two moments a vehicle is in between; after the last one it stands.
function poseAt(play, vehicle, periods) {
  const time = Math.min(Math.max(periods, 0), play.periods), passed = Math.floor(time), share = time - passed;
  const from = 3 * (passed * play.vehicles + vehicle), to = share > 0 ? from + 3 * play.vehicles : from;
  return [0, 1, 2].map((axis) => play.poses[from + axis] + share * (play.poses[to + axis] - play.poses[from + axis]));
}

function passedPeriods(play, periods) {
  return Math.floor(Math.min(Math.max(periods, 0), play.periods));
}

// What is worse comes first where several hold.
function statusAt(play, periods) {
  const passed = passedPeriods(play, periods), happened = (step) => step !== null && step <= passed;
  if (happened(play.collided_step)) return "COLLIDED";
  if (happened(play.left_step)) return "LEFT_ARENA";
  return happened(play.reached_step) ? "REACHED" : "ON_THE_WAY";
}

function farthestAt(play, targets, periods) {
  const [x, y] = targets[play.legs[passedPeriods(play, periods)]];
  let farthest = 0;
  for (let vehicle = 0; vehicle < play.vehicles; vehicle++) {
    const pose = poseAt(play, vehicle, periods);
    farthest = Math.max(farthest, Math.hypot(pose[0] - x, pose[1] - y));
  }
  return farthest;
}

function collidingAt(play, periods) {
  const passed = passedPeriods(play, periods);
  return new Set(play.collisions.filter(([period]) => period === passed - 1).map(([, vehicle]) => vehicle));
}

// The periods, from 1, in which vehicles collide that was not so in the period before.
function collisionStarts(play) {
  const periods = new Set(play.collisions.map(([period]) => period + 1));
  return [...periods].filter((period) => !periods.has(period - 1));
}

// Round numbers that divide a range into about as many parts as wanted.
function ticks(low, high, wanted) {
  const rough = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= rough - 1e-9);
  const found = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9 * step; value += step) found.push(value);
  return found;
}

class Arena {
  constructor(canvas, recorded) {
    this.canvas = canvas;
    this.recorded = recorded;
    const { x, y } = recorded.arena_mm, outside = 0.03 * Math.max(x[1] - x[0], y[1] - y[0]);
    this.low = [x[0] - outside, y[0] - outside];
    this.size = [x[1] - x[0] + 2 * outside, y[1] - y[0] + 2 * outside];
  }

  fit(width, height) {
    this.scale = Math.min(width / this.size[0], height / this.size[1]);
    this.pen = sized(this.canvas, this.scale * this.size[0], this.scale * this.size[1]);
  }

  at(x, y) {
    return [(x - this.low[0]) * this.scale, (this.low[1] + this.size[1] - y) * this.scale];
  }

  draw(world, play, periods, trailSeconds, paint) {
    const pen = this.pen;
    pen.clearRect(0, 0, this.scale * this.size[0], this.scale * this.size[1]);
    this.drawGround(paint);
    this.drawTargets(world, play.legs[passedPeriods(play, periods)], paint);
    for (const [x, y, radius] of world.obstacles_mm) this.drawObstacle(x, y, radius, paint);
    for (let vehicle = 0; vehicle < play.vehicles; vehicle++) this.drawTrail(play, vehicle, periods, trailSeconds);
    const colliding = collidingAt(play, periods);
    for (let vehicle = 0; vehicle < play.vehicles; vehicle++) {
      this.drawVehicle(poseAt(play, vehicle, periods), vehicle, colliding.has(vehicle), paint);
    }
  }

  drawGround(paint) {
    const pen = this.pen, { x, y } = this.recorded.arena_mm;
    const [left, top] = this.at(x[0], y[1]), width = (x[1] - x[0]) * this.scale, height = (y[1] - y[0]) * this.scale;
    pen.fillStyle = paint.ground;
    pen.fillRect(left, top, width, height);
    pen.strokeStyle = paint.lines;
    pen.lineWidth = 1;
    const spacing = Math.max(x[1] - x[0], y[1] - y[0]) <= 3000 ? 100 : 1000;
    pen.beginPath();
    for (let line = Math.ceil(x[0] / spacing) * spacing; line < x[1]; line += spacing) this.segment([line, y[0]], [line, y[1]]);
    for (let line = Math.ceil(y[0] / spacing) * spacing; line < y[1]; line += spacing) this.segment([x[0], line], [x[1], line]);
    pen.stroke();
    pen.strokeStyle = paint.border;
    pen.lineWidth = 1.5;
    pen.strokeRect(left, top, width, height);
  }

  segment(from, to) {
    this.pen.moveTo(...this.at(...from));
    this.pen.lineTo(...this.at(...to));
  }

  circle(x, y, radius) {
    this.pen.beginPath();
    this.pen.arc(...this.at(x, y), radius * this.scale, 0, 2 * Math.PI);
  }

  drawTargets(world, leg, paint) {
    const pen = this.pen, mark = 8 / this.scale;
    world.targets_mm.forEach(([x, y], index) => {
      const strength = index === leg ? 1 : 0.35;
      pen.fillStyle = pen.strokeStyle = paint.target;
      pen.lineWidth = 2;
      pen.globalAlpha = 0.12 * strength;
      this.circle(x, y, this.recorded.reach_mm);
      pen.fill();
      pen.globalAlpha = 0.7 * strength;
      pen.stroke();
      pen.globalAlpha = strength;
      pen.beginPath();
      this.segment([x - mark, y], [x + mark, y]);
      this.segment([x, y - mark], [x, y + mark]);
      pen.stroke();
      if (world.targets_mm.length > 1) {
        const [left, top] = this.at(x, y);
        pen.font = "600 12px system-ui, sans-serif";
        pen.textAlign = "left";
        pen.textBaseline = "bottom";
        pen.fillText(String(index + 1), left + 5, top - 4);
      }
      pen.globalAlpha = 1;
    });
  }

  drawObstacle(x, y, radius, paint) {
    const pen = this.pen;
    this.circle(x, y, radius);
    pen.fillStyle = paint.obstacle;
    pen.fill();
    pen.strokeStyle = paint.border;
    pen.lineWidth = 1;
    pen.stroke();
  }

  drawTrail(play, vehicle, periods, seconds) {
    if (seconds === 0) return;
    const pen = this.pen, rows = seconds / this.recorded.period_s, now = Math.min(periods, play.periods);
    pen.strokeStyle = this.colour(vehicle);
    pen.lineWidth = 2;
    pen.lineCap = "butt";
    let before = poseAt(play, vehicle, Math.max(0, now - rows));
    for (let moment = Math.floor(Math.max(0, now - rows)) + 1; moment < now + 1; moment++) {
      const place = poseAt(play, vehicle, Math.min(moment, now)), age = now - Math.min(moment, now);
      pen.globalAlpha = rows === Infinity ? 0.5 : 0.15 + 0.65 * (1 - age / rows);
      pen.beginPath();
      this.segment(before, place);
      pen.stroke();
      before = place;
    }
    pen.globalAlpha = 1;
  }

  drawVehicle([x, y, heading], vehicle, colliding, paint) {
    const pen = this.pen, length = this.recorded.length_mm * this.scale, width = this.recorded.width_mm * this.scale;
    if (colliding) {
      this.circle(x, y, 0.75 * this.recorded.length_mm);
      pen.strokeStyle = paint.alarm;
      pen.lineWidth = 3;
      pen.stroke();
    }
    pen.save();
    pen.translate(...this.at(x, y));
    pen.rotate(-heading);
    pen.beginPath();
    pen.roundRect(-length / 2, -width / 2, length, width, 0.25 * width);
    pen.fillStyle = this.colour(vehicle);
    pen.fill();
    pen.strokeStyle = paint.outline;
    pen.lineWidth = 1;
    pen.stroke();
    pen.beginPath();
    pen.moveTo(0.43 * length, 0);
    pen.lineTo(0.24 * length, -0.2 * width);
    pen.lineTo(0.24 * length, 0.2 * width);
    pen.closePath();
    pen.fillStyle = "#ffffff";
    pen.fill();
    pen.restore();
    const size = 0.42 * width;
    if (size < 8 || this.recorded.vehicles === 1) return;
    const back = 0.12 * this.recorded.length_mm;
    pen.font = `700 ${size}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillStyle = "#ffffff";
    pen.fillText(String(vehicle + 1), ...this.at(x - back * Math.cos(heading), y - back * Math.sin(heading)));
  }

  colour(vehicle) {
    const colours = this.recorded.vehicle_colours;
    return colours[vehicle % colours.length];
  }
}

// One quantity of all plays over time, with where the time stands now; dragging in it sets the time.
class Chart {
  constructor(canvas, periodSeconds) {
    this.canvas = canvas;
    this.periodSeconds = periodSeconds;
    this.edges = { left: 46, right: 10, top: 8, bottom: 22 };
  }

  fit(width, height) {
    this.width = width;
    this.height = height;
    this.pen = sized(this.canvas, width, height);
  }

  // lines: [{values, first, colour, marks: [{period, colour}]}]; the value at index i is that of period first + i.
  show(lines, lastPeriod, fromZero) {
    const values = lines.flatMap((line) => line.values);
    this.lines = lines;
    this.lastPeriod = Math.max(lastPeriod, 1);
    const high = Math.max(...values, fromZero ? 0 : -Infinity), low = Math.min(...values, fromZero ? 0 : Infinity);
    const spare = 0.06 * (high - low || Math.abs(high) || 1);
    this.range = [fromZero && low === 0 ? 0 : low - spare, high + spare];
  }

  across(period) {
    return this.edges.left + (period / this.lastPeriod) * (this.width - this.edges.left - this.edges.right);
  }

  up(value) {
    const [low, high] = this.range;
    return this.height - this.edges.bottom - ((value - low) / (high - low)) * (this.height - this.edges.top - this.edges.bottom);
  }

  periodAt(across) {
    const share = (across - this.edges.left) / (this.width - this.edges.left - this.edges.right);
    return Math.min(Math.max(share, 0), 1) * this.lastPeriod;
  }

  draw(periods, paint) {
    const pen = this.pen;
    pen.clearRect(0, 0, this.width, this.height);
    this.drawAxes(paint);
    for (const line of this.lines) this.drawLine(line, periods);
    pen.strokeStyle = paint.faint;
    pen.lineWidth = 1;
    pen.beginPath();
    pen.moveTo(this.across(Math.min(periods, this.lastPeriod)), this.edges.top);
    pen.lineTo(this.across(Math.min(periods, this.lastPeriod)), this.height - this.edges.bottom);
    pen.stroke();
  }

  drawAxes(paint) {
    const pen = this.pen;
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = paint.faint;
    pen.strokeStyle = paint.lines;
    pen.lineWidth = 1;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (const value of ticks(...this.range, 4)) {
      pen.beginPath();
      pen.moveTo(this.edges.left, this.up(value));
      pen.lineTo(this.width - this.edges.right, this.up(value));
      pen.stroke();
      pen.fillText(String(Number(value.toPrecision(6))).replace("-", "−"), this.edges.left - 6, this.up(value));
    }
    pen.textBaseline = "top";
    const wanted = this.width < 420 ? 4 : 7;
    for (const seconds of ticks(0, this.lastPeriod * this.periodSeconds, wanted)) {
      const place = this.across(seconds / this.periodSeconds);
      pen.textAlign = place > this.width - 24 ? "right" : "center";
      pen.fillText(`${Number(seconds.toPrecision(6))} s`, Math.min(place, this.width - 2), this.height - this.edges.bottom + 6);
    }
  }

  drawLine(line, periods) {
    const pen = this.pen;
    const stroke = (from, to, strength) => {
      pen.globalAlpha = strength;
      pen.beginPath();
      for (let index = from; index <= to; index++) pen.lineTo(this.across(line.first + index), this.up(line.values[index]));
      pen.stroke();
    };
    const last = line.values.length - 1, now = Math.min(Math.max(Math.floor(periods) - line.first, 0), last);
    pen.strokeStyle = line.colour;
    pen.lineWidth = 1.8;
    pen.lineJoin = "round";
    stroke(0, now, 1);
    stroke(now, last, 0.35);
    pen.globalAlpha = 1;
    for (const mark of line.marks) {
      pen.fillStyle = mark.colour;
      pen.beginPath();
      pen.arc(this.across(mark.period), this.up(line.values[mark.period - line.first]), 3.2, 0, 2 * Math.PI);
      pen.fill();
    }
  }
}

function sized(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  canvas.style.width = `${width}px`;
  canvas.style.height = `${height}px`;
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return pen;
}

class Viewer {
  constructor(recorded) {
    this.recorded = recorded;
    this.find = (name) => document.getElementById(name);
    this.worlds = recorded.worlds.map((world) => ({
      ...world,
      plays: world.plays.map((play) => decoded(play, recorded.vehicles)),
    }));
    this.arenas = recorded.titles.map((_, index) => new Arena(this.find(`arena-${index}`), recorded));
    this.charts = ["distance", "reward"].map((name) => new Chart(this.find(name), recorded.period_s));
    this.periods = 0;
    this.playing = false;
    this.fillStrip();
    this.listen();
    this.pick(Math.floor((this.worlds.length - 1) / 2));
  }

  get world() {
    return this.worlds[this.index];
  }

  get lastPeriod() {
    return Math.max(...this.world.plays.map((play) => play.periods));
  }

  paint() {
    const style = getComputedStyle(document.documentElement), paint = {};
    for (const name of ["ground", "lines", "border", "target", "obstacle", "alarm", "outline", "faint", "first", "second"]) {
      paint[name] = style.getPropertyValue(`--${name}`).trim();
    }
    return paint;
  }

  fillStrip() {
    this.worlds.forEach((world, index) => {
      const option = new Option(this.describe(world), String(index));
      this.find("world").add(option);
    });
    this.recorded.titles.forEach((title, motion) => {
      const row = this.find(`strip-${motion}`);
      this.worlds.forEach((world, index) => {
        const cell = document.createElement("button"), status = statusAt(world.plays[motion], Infinity);
        cell.type = "button";
        cell.className = status.toLowerCase();
        cell.title = `roll-out ${world.number}, ${title}: ${this.ending(world.plays[motion])}`;
        cell.setAttribute("aria-label", cell.title);
        cell.addEventListener("click", () => this.pick(index));
        row.append(cell);
      });
    });
  }

  describe(world) {
    const endings = [...new Set(world.plays.map((play) => this.ending(play)))];
    return `roll-out ${world.number}: ${endings.join(" · ")}`;
  }

  ending(play) {
    const status = statusAt(play, Infinity), steps = { COLLIDED: play.collided_step, LEFT_ARENA: play.left_step };
    const step = steps[status] ?? play.reached_step ?? play.periods;
    const word = status === "ON_THE_WAY" ? "not reached" : this.recorded.status_words[status];
    return `${word} after ${(step * this.recorded.period_s).toFixed(1)} s`;
  }

  listen() {
    this.find("play").addEventListener("click", () => this.toggle());
    this.find("time").addEventListener("input", (event) => this.goTo(Number(event.target.value)));
    this.find("world").addEventListener("change", (event) => this.pick(Number(event.target.value)));
    this.find("previous").addEventListener("click", () => this.pick(this.index - 1));
    this.find("next").addEventListener("click", () => this.pick(this.index + 1));
    this.find("trails").addEventListener("change", () => this.draw());
    document.addEventListener("keydown", (event) => this.press(event));
    for (const chart of this.charts) {
      const scrub = (event) => this.goTo(chart.periodAt(event.offsetX));
      chart.canvas.addEventListener("pointerdown", (event) => {
        chart.canvas.setPointerCapture(event.pointerId);
        scrub(event);
      });
      chart.canvas.addEventListener("pointermove", (event) => event.buttons && scrub(event));
    }
    new ResizeObserver(() => this.fit()).observe(this.find("stage"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.pick(this.index, this.periods));
  }

  press(event) {
    if (event.target.matches("select, input") || event.ctrlKey || event.metaKey || event.altKey) return;
    const actions = {
      " ": () => this.toggle(),
      ArrowRight: () => this.goTo(Math.floor(this.periods + 1e-6) + 1),
      ArrowLeft: () => this.goTo(Math.ceil(this.periods - 1e-6) - 1),
      ArrowDown: () => this.pick(this.index + 1),
      ArrowUp: () => this.pick(this.index - 1),
      Home: () => this.goTo(0),
      End: () => this.goTo(this.lastPeriod),
    };
    const action = actions[event.key];
    if (!action || (event.key === " " && event.target.matches("button"))) return;
    event.preventDefault();
    action();
  }

  pick(index, periods = 0) {
    this.index = Math.min(Math.max(index, 0), this.worlds.length - 1);
    this.find("world").value = String(this.index);
    this.find("previous").disabled = this.index === 0;
    this.find("next").disabled = this.index === this.worlds.length - 1;
    this.find("time").max = String(this.lastPeriod);
    document.querySelectorAll(".strip").forEach((row) => {
      [...row.children].forEach((cell, place) => cell.setAttribute("aria-pressed", String(place === this.index)));
    });
    this.fillCharts();
    this.periods = periods;
    this.fit();
  }

  fillCharts() {
    const paint = this.paint(), colours = [paint.first, paint.second], plays = this.world.plays;
    const marks = (play) => [
      ...collisionStarts(play).map((period) => ({ period, colour: paint.alarm })),
      ...(play.left_step === null ? [] : [{ period: play.left_step, colour: paint.alarm }]),
      ...(play.reached_step === null ? [] : [{ period: play.reached_step, colour: paint.target }]),
    ];
    const distances = plays.map((play, motion) => ({
      first: 0,
      values: Array.from({ length: play.periods + 1 }, (_, period) => farthestAt(play, this.world.targets_mm, period)),
      colour: colours[motion % 2],
      marks: marks(play),
    }));
    const rewards = plays.map((play, motion) => ({ first: 1, values: play.rewards, colour: colours[motion % 2], marks: [] }));
    this.charts[0].show(distances, this.lastPeriod, true);
    this.charts[1].show(rewards, this.lastPeriod, false);
  }

  fit() {
    const most = Math.max(240, 0.68 * window.innerHeight);
    this.arenas.forEach((arena) => arena.fit(arena.canvas.parentElement.clientWidth, most));
    this.charts.forEach((chart) => chart.fit(chart.canvas.parentElement.clientWidth, 170));
    this.draw();
  }

  toggle() {
    this.playing = !this.playing;
    if (this.playing && this.periods >= this.lastPeriod) this.periods = 0;
    this.showPlaying();
    if (this.playing) requestAnimationFrame((now) => this.advance(now, now));
  }

  advance(before, now) {
    if (!this.playing) return;
    const speed = Number(this.find("speed").value);
    this.periods += ((now - before) / 1000) * (speed / this.recorded.period_s);
    if (this.periods >= this.lastPeriod) {
      this.periods = this.lastPeriod;
      this.playing = false;
      this.showPlaying();
    }
    this.draw();
    requestAnimationFrame((next) => this.advance(now, next));
  }

  showPlaying() {
    const button = this.find("play");
    button.classList.toggle("playing", this.playing);
    button.setAttribute("aria-label", this.playing ? "pause" : "play");
  }

  goTo(periods) {
    this.periods = Math.min(Math.max(periods, 0), this.lastPeriod);
    this.draw();
  }

  draw() {
    const paint = this.paint(), periods = this.periods, trail = Number(this.find("trails").value);
    this.arenas.forEach((arena, motion) => {
      arena.draw(this.world, this.world.plays[motion], periods, trail, paint);
      this.tell(motion, this.world.plays[motion]);
    });
    this.charts.forEach((chart) => chart.draw(periods, paint));
    this.find("time").value = String(periods);
    const seconds = (count) => (count * this.recorded.period_s).toFixed(1);
    this.find("now").textContent = `${seconds(periods)} of ${seconds(this.lastPeriod)} s`;
  }

  tell(motion, play) {
    const status = statusAt(play, this.periods), pill = this.find(`status-${motion}`);
    const passed = passedPeriods(play, this.periods), reward = passed ? play.rewards[passed - 1].toFixed(2) : "";
    pill.className = `status ${status.toLowerCase()}`;
    pill.textContent = this.recorded.status_words[status];
    this.find(`distance-${motion}`).textContent = `${farthestAt(play, this.world.targets_mm, this.periods).toFixed(0)} mm`;
    this.find(`reward-${motion}`).textContent = reward.replace("-", "−") || "none yet";
  }
}

if (typeof document !== "undefined") {
  window.viewer = new Viewer(JSON.parse(document.getElementById("recorded").textContent));
}
