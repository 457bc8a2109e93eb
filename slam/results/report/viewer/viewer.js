// Turns the picture of a map into a view that follows mouse, touch and keys. Without WebGL the picture stays.
"use strict";
(async () => {
  const figure = document.getElementById("map-viewer");
  const part = name => figure.querySelector(`[data-part="${name}"]`);
  const canvas = part("canvas");

  async function load() {
    if (!canvas.getContext("webgl2")) throw new Error("WebGL 2 is not available");
    await runPacked(part("three"));
    return geometry(JSON.parse(part("about").textContent), await unpacked(part("mesh")));
  }

  // Positions as 16 bit fractions of a box, colours, and each corner's number less that of the corner before
  function geometry(about, bytes) {
    const positions = new Uint16Array(bytes, 0, 3 * about.vertices);
    const colours = new Uint8Array(bytes, positions.byteLength, 3 * about.vertices);
    const start = positions.byteLength + colours.byteLength + about.padding;
    const corners = Uint32Array.from(new Int32Array(bytes, start, 3 * about.triangles));
    for (let k = 1; k < corners.length; k++) corners[k] += corners[k - 1];
    const points = Float32Array.from(positions, (value, k) => about.low[k % 3] + value * about.step[k % 3]);
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.BufferAttribute(points, 3));
    shape.setAttribute("color", new THREE.BufferAttribute(linear(colours), 3));
    shape.setIndex(new THREE.BufferAttribute(corners, 1));
    return { about, shape };
  }

  function linear(colours) {
    const table = Float32Array.from({ length: 256 }, (_, value) => {
      const share = value / 255;
      return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    });
    return Float32Array.from(colours, value => table[value]);
  }

  function show({ about, shape }) {
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    renderer.setClearColor(about.background);
    const scene = new THREE.Scene();
    scene.add(new THREE.Mesh(shape, new THREE.MeshBasicMaterial({ vertexColors: true, side: 2 })));
    const path = new THREE.BufferGeometry();
    path.setAttribute("position", new THREE.BufferAttribute(new Float32Array(about.path), 3));
    scene.add(new THREE.Line(path, new THREE.LineBasicMaterial({ color: "#0072b2" })));
    shape.computeBoundingSphere();
    const { center, radius } = shape.boundingSphere;
    const camera = new THREE.PerspectiveCamera(about.field_of_view_deg, 16 / 9, 0.1, 20 * radius + 100);
    const controls = new THREE.OrbitControls(camera, canvas);

    const draw = () => renderer.render(scene, camera);
    function look(from, to) {
      camera.position.copy(from);
      controls.target.copy(to);
      controls.update();
      draw();
    }
    function fit() {
      const { clientWidth: width, clientHeight: height } = canvas;
      if (!width || !height) return;
      renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      draw();
    }
    const views = {
      seat: () => look(new THREE.Vector3(...about.seat), new THREE.Vector3(...about.ahead)),
      above: () => {
        const away = 1.05 * radius / Math.sin(Math.PI / 360 * about.field_of_view_deg);
        look(new THREE.Vector3(center.x, center.y + away, center.z + 0.001 * away), center);
      },
    };
    for (const button of figure.querySelectorAll("button")) button.onclick = views[button.dataset.view];

    // The page scrolls over the view until it is chosen by a click, a tap or the tab key
    function choose(chosen) {
      controls.enableZoom = chosen;
      controls.touches.ONE = chosen ? 0 : -1;
      canvas.style.touchAction = chosen ? "none" : "pan-y pinch-zoom";
    }
    canvas.onfocus = () => choose(true);
    canvas.onblur = () => choose(false);
    canvas.onpointerdown = event => event.pointerType === "mouse" && canvas.focus();
    canvas.onclick = () => canvas.focus();
    canvas.onkeydown = event => {
      if (event.key === "+" || event.key === "=") controls.dollyIn(1.25);
      else if (event.key === "-") controls.dollyOut(1.25);
      else return;
      event.preventDefault();
    };
    controls.keyPanSpeed = controls.keyRotateSpeed = 20;
    controls.listenToKeyEvents(canvas);
    controls.addEventListener("change", draw);
    choose(false);
    figure.classList.add("live");
    new ResizeObserver(fit).observe(canvas);
    fit();
    views.seat();
  }

  try {
    show(await load());
  } catch (error) {
    part("without").textContent = `The map cannot be turned here: ${error.message}.`;
  }
})();
