// Draws the charts of a page, switches runs on and off, and keeps one time for all of it.
const page = JSON.parse(document.getElementById('data').textContent);

const numbers = await (async () => {
  const text = atob(document.getElementById('numbers').textContent);
  const bytes = Uint8Array.from(text, letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = planes.length / 2, made = new Int16Array(count);
  for (let k = 0; k < count; k++) made[k] = planes[k] | planes[count + k] << 8;
  return made;
})();

function unpacked({at, count, low, step, log}) {
  const values = new Array(count);
  for (let k = 0, sum = 0; k < count; k++) {
    sum = (sum + numbers[at + k]) << 16 >> 16;
    const value = low + step * (sum + 32767);
    values[k] = sum === -32768 ? null : log ? 10 ** value : value;
  }
  return values;
}

const times = Array.from({length: page.time.count}, (_, k) => page.time.start + k * page.time.step);
const clock = {now: 0, listeners: [], set(now) {
  this.now = Math.min(Math.max(now, times[0]), times[times.length - 1]);
  for (const listen of this.listeners) listen(this.now);
}};
const shown = page.runs.map(() => true);
const runListeners = [];
const plots = [];       // {plot, spec, timed, mark}
const DASHES = {dash: [8, 4], dot: [2, 3]};

function rounded(value) {
  if (value === null || value === undefined) return '–';
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(2)
    : String(+value.toPrecision(4));
}

function inside(plot, draw) {
  const {ctx, bbox} = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  draw(ctx, bbox, devicePixelRatio);
  ctx.restore();
}

// Below the grid.
function windows(spec) {
  return plot => inside(plot, (ctx, bbox) => {
    for (const [from, to, colour] of spec.windows) {
      const left = plot.valToPos(from, 'x', true), right = plot.valToPos(to, 'x', true);
      ctx.fillStyle = colour;
      ctx.fillRect(left, bbox.top, right - left, bbox.height);
    }
  });
}

// Above the grid and below the series, with a light edge around the text.
function marks(spec) {
  return plot => inside(plot, (ctx, bbox, ratio) => {
    const write = (text, x, y) => {
      ctx.save();
      ctx.setLineDash([]);
      ctx.strokeStyle = '#ffffff';
      ctx.lineWidth = 4 * ratio;
      ctx.strokeText(text, x, y);
      ctx.fillText(text, x, y);
      ctx.restore();
    };
    ctx.strokeStyle = '#8a939d';
    ctx.fillStyle = '#3b444e';
    ctx.lineWidth = ratio;
    ctx.font = `${11 * ratio}px system-ui, sans-serif`;
    ctx.setLineDash([4 * ratio, 3 * ratio]);
    for (const [x, text] of spec.upright) {
      const at = plot.valToPos(x, 'x', true);
      ctx.beginPath(); ctx.moveTo(at, bbox.top); ctx.lineTo(at, bbox.top + bbox.height); ctx.stroke();
      const fits = at + 6 * ratio + ctx.measureText(text).width < bbox.left + bbox.width;
      ctx.textAlign = fits ? 'left' : 'right';
      write(text, at + (fits ? 3 : -3) * ratio, bbox.top + 11 * ratio);
    }
    ctx.textAlign = 'left';
    for (const [y, text] of spec.level) {
      const at = plot.valToPos(y, 'y', true);
      ctx.beginPath(); ctx.moveTo(bbox.left, at); ctx.lineTo(bbox.left + bbox.width, at); ctx.stroke();
      write(text, bbox.left + 4 * ratio, at - 3 * ratio);
    }
  });
}

let following = false;
function alignTimes(plot, key) {
  if (key !== 'x' || following) return;
  following = true;
  const {min, max} = plot.scales.x;
  for (const other of plots) {
    if (other.timed && other.plot !== plot) other.plot.setScale('x', {min, max});
    moveMark(other);
  }
  following = false;
}

function setWindow(min, max) {
  const first = plots.find(entry => entry.timed);
  if (first) first.plot.setScale('x', {min, max});
}

function moveMark(entry) {
  if (!entry.timed) return;
  const at = entry.plot.valToPos(clock.now, 'x');
  const inside = at >= 0 && at <= entry.plot.over.clientWidth;
  entry.mark.style.display = inside ? '' : 'none';
  entry.mark.style.transform = `translateX(${at}px)`;
}

function seekOnClick(plot) {
  let pressed = 0;
  plot.over.addEventListener('pointerdown', event => { pressed = event.clientX; });
  plot.over.addEventListener('click', event => {
    if (Math.abs(event.clientX - pressed) < 4)
      clock.set(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, 'x'));
  });
}

// Of a logarithmic axis, only the powers of ten have a line and a label.
function powers(plot, splits) {
  return splits.map(value => value !== null
    && Math.abs(Math.log10(value) - Math.round(Math.log10(value))) < 1e-9 ? value : null);
}

function decades(plot, splits) {
  return powers(plot, splits).map(value => value === null ? null
    : value < 1e-3 || value >= 1e5 ? value.toExponential(0) : rounded(value));
}

function draw(holder) {
  const spec = page.charts[holder.dataset.chart], timed = spec.x === null;
  const narrow = holder.clientWidth < 520;
  const lines = log => log ? {filter: powers} : {};
  const axis = log => ({
    stroke: '#3b444e', font: '11px system-ui, sans-serif', grid: {stroke: '#e6e9ed', ...lines(log)},
    ticks: {stroke: '#c9d0d8', size: 4, ...lines(log)}, ...(log ? {values: decades} : {})});
  const series = [{label: timed ? 't [s]' : spec.xlabel, value: (_, value) => rounded(value)}];
  const bands = [];
  for (const line of spec.series) {
    series.push({
      label: line.label, stroke: line.colour, width: line.style === 'dot' ? 1 : 1.4,
      dash: DASHES[line.style], value: (_, value) => rounded(value), spanGaps: false,
      paths: line.style === 'step' ? uPlot.paths.stepped({align: 1}) : undefined,
      points: {show: line.style === 'points', size: 6, fill: line.colour}});
    if (line.band)
      bands.push({series: [series.length - 1, series.length - 2], fill: line.colour + '28'});
  }
  const scale = log => log ? {distr: 3} : {};
  const plot = new uPlot({
    width: holder.clientWidth, height: narrow ? 190 : 210, series, bands,
    scales: {x: {time: false, ...scale(spec.log[0])}, y: scale(spec.log[1])},
    axes: [{...axis(spec.log[0]), size: 34},
           {values: (_, splits) => splits.map(rounded), ...axis(spec.log[1]),
            size: narrow ? 46 : 56}],
    cursor: {sync: timed ? {key: 'time'} : undefined, drag: {x: true, y: false, dist: 5},
             points: {size: 6}},
    legend: {live: true},
    hooks: {drawClear: [windows(spec)], drawAxes: [marks(spec)], setScale: timed ? [alignTimes] : []},
  }, [timed ? times : unpacked(spec.x), ...spec.series.map(line => unpacked(line.y))], holder);
  const title = document.createElement('div');
  title.className = 'label';
  title.textContent = spec.label;
  holder.prepend(title);
  const entry = {plot, spec, timed, mark: document.createElement('div')};
  if (timed) {
    entry.mark.className = 'now';
    plot.over.append(entry.mark);
    seekOnClick(plot);
  }
  plots.push(entry);
  new ResizeObserver(() => {
    if (holder.clientWidth && holder.clientWidth !== plot.width)
      plot.setSize({width: holder.clientWidth, height: plot.height});
    moveMark(entry);
  }).observe(holder);
}

for (const holder of document.querySelectorAll('[data-chart]')) draw(holder);
clock.listeners.push(() => plots.forEach(moveMark));

for (const box of document.querySelectorAll('input[data-run]')) {
  box.addEventListener('change', () => {
    const run = +box.dataset.run;
    shown[run] = box.checked;
    for (const {plot, spec} of plots)
      spec.series.forEach((line, k) => {
        if (line.run === run) plot.setSeries(k + 1, {show: box.checked});
      });
    for (const part of document.querySelectorAll(`[data-of-run="${run}"]`))
      part.hidden = !box.checked;
    runListeners.forEach(listen => listen());
  });
}

const slider = document.getElementById('slider'), play = document.getElementById('play');
if (slider) {
  const told = document.getElementById('time'), speed = document.getElementById('speed');
  slider.min = times[0]; slider.max = times[times.length - 1]; slider.step = page.time.step;
  slider.addEventListener('input', () => clock.set(+slider.value));
  clock.listeners.push(now => {
    slider.value = now;
    told.textContent = `${now.toFixed(1)} s`;
    for (const pin of document.querySelectorAll('.pin'))
      pin.style.left = `${100 * (now - times[0]) / (times[times.length - 1] - times[0])}%`;
  });
  let playing = false, last = 0;
  const step = stamp => {
    if (!playing) return;
    const end = times[times.length - 1];
    clock.set(clock.now + Math.min(stamp - last, 100) / 1000 * +speed.value);
    last = stamp;
    if (clock.now >= end) toggle(); else requestAnimationFrame(step);
  };
  const toggle = () => {
    playing = !playing;
    play.textContent = playing ? 'Pause' : 'Play';
    if (!playing) return;
    if (clock.now >= times[times.length - 1]) clock.set(0);
    last = performance.now();
    requestAnimationFrame(step);
  };
  play.addEventListener('click', toggle);
  document.addEventListener('keydown', event => {
    if (event.key === ' ' && !/INPUT|SELECT|BUTTON|SUMMARY/.test(event.target.tagName)) {
      event.preventDefault(); toggle();
    }
  });
  const zoom = factor => {
    const first = plots.find(entry => entry.timed);
    if (!first) return;
    const {min, max} = first.plot.scales.x, half = (max - min) * factor / 2;
    const middle = clock.now >= min && clock.now <= max ? clock.now : (min + max) / 2;
    setWindow(Math.max(times[0], middle - half), Math.min(times[times.length - 1], middle + half));
  };
  document.getElementById('nearer').addEventListener('click', () => zoom(0.5));
  document.getElementById('further').addEventListener('click', () => zoom(2));
  document.getElementById('all').addEventListener('click',
    () => setWindow(times[0], times[times.length - 1]));
  for (const strip of document.querySelectorAll('.strip'))
    strip.addEventListener('click', event => {
      const box = strip.getBoundingClientRect();
      clock.set(times[0] + (event.clientX - box.left) / box.width
        * (times[times.length - 1] - times[0]));
    });
}
