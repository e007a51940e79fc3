// Pictures of original and result: a slider between them, their difference, a zoom that all share.
(() => {
  const stage = document.querySelector('#pictures');
  if (!stage) return;
  const frames = [...stage.querySelectorAll('.frame')];
  const views = [...stage.querySelectorAll('.view')];
  const cut = stage.querySelector('#cut'), gain = stage.querySelector('#gain');
  let zoom = 1, x = 0.5, y = 0.5; // the point of the picture that is in the middle

  function draw() {
    const half = 0.5 / zoom;
    x = Math.min(Math.max(x, half), 1 - half);
    y = Math.min(Math.max(y, half), 1 - half);
    const left = 0.5 - x * zoom, top = 0.5 - y * zoom;
    for (const frame of frames) {
      frame.classList.toggle('zoomed', zoom > 1);
      frame.classList.toggle('close', zoom >= 3);
      const layers = frame.querySelector('.layers');
      layers.style.transform = `translate(${100 * left}%, ${100 * top}%) scale(${zoom})`;
      // the divider stays where it is on the screen, whatever is behind it
      frame.style.setProperty('--cut', `${(100 * (cut.value / 100 - left)) / zoom}%`);
      frame.style.setProperty('--gain', gain.value);
      frame.querySelector('.divider').style.left = `${cut.value}%`;
    }
    stage.querySelector('#zoom').textContent = `${Math.round(100 * zoom)} %`;
  }
  function zoomBy(factor, atX = 0.5, atY = 0.5) {
    const before = zoom;
    zoom = Math.min(Math.max(zoom * factor, 1), 16);
    x += (atX - 0.5) * (1 / before - 1 / zoom);
    y += (atY - 0.5) * (1 / before - 1 / zoom);
    draw();
  }
  function setMode(mode) {
    for (const frame of frames) frame.dataset.mode = mode;
    stage.querySelector('.cut').hidden = mode !== 'slider';
    stage.querySelector('.gain').hidden = mode !== 'difference';
  }
  for (const input of stage.querySelectorAll('input[name=mode]'))
    input.addEventListener('change', () => setMode(input.value));
  cut.addEventListener('input', draw);
  gain.addEventListener('input', draw);
  stage.querySelector('#closer').addEventListener('click', () => zoomBy(1.5));
  stage.querySelector('#farther').addEventListener('click', () => zoomBy(1 / 1.5));
  stage.querySelector('#whole').addEventListener('click', () => { zoom = 1; draw(); });
  const thumbs = [...stage.querySelectorAll('.thumbs button')];
  thumbs.forEach((button, k) => button.addEventListener('click', () => {
    views.forEach((view, i) => { view.hidden = i !== k; });
    thumbs.forEach((other, i) => other.setAttribute('aria-pressed', i === k));
  }));

  for (const frame of frames) {
    const fingers = new Map();
    const at = (e) => {
      const box = frame.getBoundingClientRect();
      return [(e.clientX - box.left) / box.width, (e.clientY - box.top) / box.height];
    };
    frame.addEventListener('pointerdown', (e) => {
      frame.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, at(e));
      if (zoom === 1 && frame.dataset.mode === 'slider') { cut.value = 100 * at(e)[0]; draw(); }
    });
    frame.addEventListener('pointermove', (e) => {
      const before = fingers.get(e.pointerId);
      if (!before) return;
      const now = at(e);
      if (fingers.size === 2) {
        const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
        const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        zoomBy(apart(now) / Math.max(apart(before), 1e-3), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      } else if (zoom > 1) {
        x -= (now[0] - before[0]) / zoom;
        y -= (now[1] - before[1]) / zoom;
        draw();
      } else if (frame.dataset.mode === 'slider') { cut.value = 100 * now[0]; draw(); }
      fingers.set(e.pointerId, now);
    });
    for (const end of ['pointerup', 'pointercancel'])
      frame.addEventListener(end, (e) => fingers.delete(e.pointerId));
    frame.addEventListener('dblclick', (e) => zoomBy(zoom < 4 ? 2 : 1 / 16, ...at(e)));
    frame.addEventListener('wheel', (e) => {
      if (!e.ctrlKey && zoom === 1) return; // the page scrolls
      e.preventDefault();
      zoomBy(Math.exp(-e.deltaY / 300), ...at(e));
    }, { passive: false });
    frame.addEventListener('keydown', (e) => {
      const step = 0.1 / zoom, left = e.key === 'ArrowLeft', right = e.key === 'ArrowRight';
      if (e.key === '+' || e.key === '=') zoomBy(1.5);
      else if (e.key === '-') zoomBy(1 / 1.5);
      else if (e.key === '0') { zoom = 1; draw(); }
      else if (zoom === 1 && (left || right)) { cut.value = +cut.value + (left ? -2 : 2); draw(); }
      else if (left || right) { x += left ? -step : step; draw(); }
      else if (zoom > 1 && e.key === 'ArrowUp') { y -= step; draw(); }
      else if (zoom > 1 && e.key === 'ArrowDown') { y += step; draw(); }
      else return;
      e.preventDefault();
    });
  }
  setMode('slider');
  draw();
})();
