// Drives the page of the live view in Chromium, as its users do: node drive.mjs OUTPUT_FOLDER [--strict]; see browser.sh.
import {spawn, spawnSync} from "node:child_process";
import {mkdtempSync, readFileSync, readdirSync, rmSync, writeFileSync} from "node:fs";
import {createRequire} from "node:module";
import {tmpdir} from "node:os";
import {join} from "node:path";
import readline from "node:readline";

const env = process.env, output = process.argv[2], isStrict = process.argv[3] === "--strict";
const puppeteer = createRequire(join(env.DFB_LIVE_NODE_MODULES, "index.js"))("puppeteer-core");
const mpiexec = env.DFB_MPIEXEC.split(";");
// Of the picture; rays of ambient occlusion; samples a pixel.
const [width, height, rays, samples] = isStrict ? [1024, 768, 4, 4] : [768, 576, 0, 2];
const scratch = mkdtempSync(join(tmpdir(), "dfb_live_"));

// A mesh and a volume that take little time. Cut by content, bricks would depend on the camera.
const scene = [join(scratch, "torus.ply"), join(scratch, "cloud_12x12x12_uint8.raw"), "--opacity", "1", "--cut", "volume"];
{
  const around = 96, across = 48, vertices = [], faces = [];
  for (let i = 0; i < around; ++i)
    for (let j = 0; j < across; ++j) {
      const a = 2 * Math.PI * i / around, b = 2 * Math.PI * j / across, r = 3 + Math.cos(b);
      vertices.push([r * Math.cos(a), Math.sin(b) + 0.4 * Math.sin(3 * a), r * Math.sin(a)].map(x => x.toFixed(4)).join(" "));
      const at = (k, l) => (k % around) * across + l % across;
      faces.push(`4 ${at(i, j)} ${at(i, j + 1)} ${at(i + 1, j + 1)} ${at(i + 1, j)}`);
    }
  writeFileSync(scene[0], `ply\nformat ascii 1.0\nelement vertex ${vertices.length}\nproperty float x\nproperty float y\n` +
    `property float z\nelement face ${faces.length}\nproperty list uchar int vertex_indices\nend_header\n` +
    vertices.concat(faces).join("\n") + "\n");
  writeFileSync(scene[1], Uint8Array.from({length: 12 ** 3}, (_, i) => {
    const [x, y, z] = [i % 12, Math.floor(i / 12) % 12, Math.floor(i / 144)].map(n => (n - 5.5) / 5.5);
    return Math.max(0, 255 * (0.9 - Math.hypot(x, 1.6 * y, z) + 0.2 * Math.sin(5 * x) * Math.cos(4 * z)));
  }));
}

function check(isRight, text) {
  if (!isRight)
    throw new Error(text);
  console.log("ok: " + text);
}
const median = list => [...list].sort((a, b) => a - b)[Math.floor(list.length / 2)];

// A job of two ranks, with the address that it prints.
async function start(program, ...words) {
  const job = spawn(mpiexec[0], [...mpiexec.slice(1), "2", program, ...words, "--live", "0"], {stdio: ["ignore", "pipe", "inherit"]});
  job.ended = new Promise(done => job.on("exit", (code, signal) => done(signal || code)));
  jobs.push(job);
  job.url = await new Promise((found, failed) => {
    readline.createInterface({input: job.stdout}).on("line", line => {
      const url = line.match(/http:\S+/);
      if (url)
        found(url[0]);
    });
    job.ended.then(code => failed(new Error("the job has ended with " + code + " and printed no address")));
  });
  return job;
}

const jobs = [], scriptErrors = [];
const browser = await puppeteer.launch({
  executablePath: env.DFB_CHROMIUM || "/usr/bin/chromium", headless: true,
  args: ["--no-sandbox", "--disable-dev-shm-usage", "--force-color-profile=srgb"],
});

// ---- what is done to a page

const panel = 256; // pixels beside the picture
async function open(url) {
  const page = await browser.newPage();
  page.on("pageerror", error => scriptErrors.push(error));
  await page.setViewport({width: width + panel, height});
  await page.goto(url);
  const session = await page.createCDPSession();
  await session.send("Browser.setDownloadBehavior", {behavior: "allow", downloadPath: scratch});
  return page;
}
const until = (page, condition, ...args) => page.waitForFunction(condition, {timeout: 60000, polling: "raf"}, ...args);
const look = (page, what, ...args) => page.evaluate(what, ...args);
const shows = (page, width, height) =>
  until(page, (w, h) => liveView.state === "shows" && liveView.width === w && liveView.height === h, width, height);
// The picture of what this page has asked for last, with all samples, and its statistics.
const refined = page => until(page, () => {
  const now = liveView.stats;
  return !liveView.isAsking && !liveView.isMoving && now && now.frame && now.frame.wishes >= liveView.asked && now.frame.wishes === now.wishes.number && now.frame.samples >= now.wishes.samples
         && liveView.frame === now.frame.number && now.times[now.times.length - 1][0] === now.frame.number;
});
async function drag(page, from, to, steps, options = {}) {
  await page.mouse.move(...from);
  await page.mouse.down(options);
  await page.mouse.move(...to, {steps});
  await page.mouse.up(options);
}

// Drags without a rest until `wanted` pictures have come, two minutes at most. `took`: times from an event to its picture.
async function keepDragging(page, wanted) {
  const count = await look(page, () => {
    liveView.latencies.length = 0;
    return liveView.pictures;
  }), begin = performance.now();
  await page.mouse.move(400, 400);
  await page.mouse.down();
  for (let i = 0; await look(page, n => liveView.pictures - n, count) < wanted && performance.now() - begin < 120000; ++i) {
    await page.mouse.move(400 + 150 * Math.sin(0.05 * i), 400 + 60 * Math.sin(0.031 * i));
    await look(page, () => new Promise(requestAnimationFrame)); // a mouse has as many events as a screen has pictures
  }
  await page.mouse.up();
  const seconds = (performance.now() - begin) / 1000;
  const [frames, took] = await look(page, n => [liveView.pictures - n, liveView.latencies.map(l => l.took)], count);
  return {frames, seconds, took};
}

// How long the browser alone takes to get and show a picture that is there, after a pause: median of `count`, in ms.
async function ownTime(page, count) {
  return median(await look(page, async count => {
    const times = [];
    for (let i = 0; i < count; ++i) {
      for (let paused = 0; paused < 20; ++paused)
        await new Promise(requestAnimationFrame);
      const begin = performance.now();
      context.drawImage(await createImageBitmap(await (await fetch(address("/frame", {after: 0}))).blob()), 0, 0);
      await onScreen();
      times.push(performance.now() - begin);
    }
    return times;
  }, count));
}

// The picture that the button saves.
async function save(page) {
  const before = new Set(readdirSync(scratch));
  await page.click("#save");
  for (;;) {
    const name = readdirSync(scratch).find(n => n.endsWith(".png") && !before.has(n));
    if (name)
      return readFileSync(join(scratch, name));
    await new Promise(done => setTimeout(done, 20)); // the browser tells nobody when a file is there
  }
}
// How many pixels of two PNGs differ, as a browser sees them.
async function difference(page, one, other) {
  return page.evaluate(async (...texts) => {
    const pixels = [];
    for (const text of texts) {
      const image = new Image();
      image.src = "data:image/png;base64," + text;
      await image.decode();
      const canvas = new OffscreenCanvas(image.width, image.height), context = canvas.getContext("2d");
      context.drawImage(image, 0, 0);
      pixels.push({size: image.width + "x" + image.height, data: context.getImageData(0, 0, image.width, image.height).data});
    }
    if (pixels[0].size !== pixels[1].size)
      return pixels[0].size + " and " + pixels[1].size;
    let count = 0;
    for (let i = 0; i < pixels[0].data.length; i += 4)
      count += [0, 1, 2, 3].some(c => pixels[0].data[i + c] !== pixels[1].data[i + c]);
    return count;
  }, one.toString("base64"), other.toString("base64"));
}
async function equalsOffline(page, what) {
  await refined(page);
  const words = (await page.$eval("#words", e => e.textContent)).split(" ");
  const live = await save(page), file = join(scratch, "offline.png");
  const made = spawnSync(env.DFB_RENDER, [...scene, "--ranks", "2", ...words, "--output", file]);
  if (made.status !== 0)
    throw new Error("offline: " + made.stderr);
  const offline = readFileSync(file);
  rmSync(file);
  const differs = await difference(page, live, offline);
  check(differs === 0, `${what}: the saved picture has ${differs} pixels that differ from dfb_render ${words.join(" ")}`);
}

try {
  // ---- dfb_render

  const job = await start(env.DFB_RENDER, ...scene, "--spp", String(samples), "--ao", String(rays));
  const page = await open(job.url);
  await shows(page, width, height);
  await refined(page);
  check(true, "the page shows a picture of the size of its stage");
  await page.screenshot({path: join(output, "page.png")});

  const before = await look(page, () => ({...liveView.stats.frame.camera}));
  await drag(page, [500, 400], [640, 330], 12);
  await equalsOffline(page, "dragged");
  await page.keyboard.down("Shift");
  await drag(page, [500, 400], [560, 430], 5);
  await page.keyboard.up("Shift");
  await page.mouse.move(500, 400);
  await page.mouse.wheel({deltaY: -300});
  await page.keyboard.press("ArrowLeft");
  await equalsOffline(page, "turned, moved, zoomed, turned by a key");
  const after = await look(page, () => ({...liveView.stats.frame.camera, distance: liveView.stats.frame.distance}));
  check(after.azimuth !== before.azimuth && after.elevation !== before.elevation && after.target[1] !== before.target[1],
        "mouse and keys turn and move");

  // Pinching.
  const touch = await page.createCDPSession();
  const fingers = (type, ...at) => touch.send("Input.dispatchTouchEvent", {type, touchPoints: at.map(([x, y], id) => ({x, y, id}))});
  await fingers("touchStart", [400, 300], [600, 300]);
  await fingers("touchMove", [350, 300], [650, 300]);
  await fingers("touchEnd");
  await refined(page);
  const pinched = await look(page, () => liveView.stats.frame.distance);
  check(Math.abs(pinched / after.distance - 200 / 300) < 0.05, `two fingers zoom: ${after.distance} becomes ${pinched}`);
  await page.keyboard.press("0");
  await refined(page);
  const home = await look(page, () => ({...liveView.stats.frame.camera}));
  check(JSON.stringify(home) === JSON.stringify(before), "the camera goes back");

  // ---- many frames while dragging, and how long they take

  await page.select("#moving", "1");
  const wanted = isStrict ? 100 : 12, repetitions = isStrict ? 41 : 9, atFullSize = await keepDragging(page, wanted);
  await shows(page, width, height);
  check(atFullSize.frames >= wanted, `${atFullSize.frames} frames of ${width}x${height} while dragging in ${atFullSize.seconds.toFixed(1)} s: ${(atFullSize.frames / atFullSize.seconds).toFixed(1)} a second`);
  console.log(`while the pointer goes on moving: ${median(atFullSize.took).toFixed(1)} ms from an event to its picture (median of ${atFullSize.took.length})`);

  await refined(page);
  const took = [], times = [];
  await page.mouse.move(500, 400);
  await page.mouse.down();
  for (let i = 0; i < repetitions; ++i) {
    const known = await look(page, () => liveView.latencies.length);
    await page.mouse.move(500 + 3 * (i % 20) + 1, 400 + i % 7);
    await until(page, n => liveView.latencies.length > n, known);
    const [latency, time] = await page.evaluate(async () => {
      const {wishes, took} = liveView.latencies[liveView.latencies.length - 1];
      const token = new URLSearchParams(location.search).get("token");
      const stats = await (await fetch("/stats?token=" + token)).json();
      return [took, (stats.times.find(t => t[0] === liveView.frame) || [0, 0])[1]];
    });
    if (time > 0) {
      took.push(latency);
      times.push(time);
    }
  }
  await page.mouse.up();
  console.log(`from a pointer event to its picture on the screen ${median(took).toFixed(1)} ms, a frame takes ${median(times).toFixed(1)} ms ` +
              `(medians of ${took.length}, ${width}x${height}, 2 ranks)`);
  await refined(page);
  const alone = await ownTime(page, isStrict ? 15 : 7), excess = median(took) - median(times);
  console.log(`the browser alone takes ${alone.toFixed(1)} ms to get and show a picture`);
  if (isStrict)
    check(excess <= 30, "that is a frame's time and 30 ms at most");
  // On a slow or busy machine all takes longer: the frame, and what the browser does by itself.
  check(excess <= Math.max(30, 0.1 * median(times)) + alone, "that is the times of a frame and of the browser, and 30 ms or a tenth at most");

  // ---- reload in mid-drag, resize, tiles, a second viewer

  await page.mouse.move(500, 400);
  await page.mouse.down();
  await page.mouse.move(560, 420, {steps: 4});
  await page.reload();
  await shows(page, width, height);
  await page.mouse.up();
  await drag(page, [500, 400], [450, 380], 6);
  await equalsOffline(page, "reloaded in mid-drag, then dragged again");

  await page.setViewport({width: 644 + panel, height: 500});
  await shows(page, 644, 500);
  await equalsOffline(page, "the window resized");
  await page.setViewport({width: width + panel, height});
  await shows(page, width, height);
  await refined(page);

  await page.click("#overlay");
  await until(page, () => document.querySelectorAll("#owners span").length === 2);
  check(true, "the tiles of both ranks are shown");
  await page.screenshot({path: join(output, "tiles.png")});
  await page.click("#overlay");

  const second = await open(job.url);
  await shows(second, width, height);
  await second.keyboard.press("ArrowRight");
  const turned = await second.waitForFunction(() => liveView.wishes > 0 && liveView.latencies.length && liveView.wishes);
  await until(page, wishes => liveView.wishes >= wishes, await turned.jsonValue());
  check(true, "a second viewer turns the picture of the first");

  await page.select("#moving", "2");
  await page.bringToFront();
  await page.mouse.move(500, 400);
  await page.mouse.down();
  await page.mouse.move(520, 400, {steps: 3});
  await shows(page, width / 2, height / 2);
  await page.mouse.up();
  await shows(page, width, height);
  check(true, "half of the size while moving");
  await look(page, whole => { // pictures are slow to come: later than the pause after which the camera rests
    window.fetchAtOnce = window.fetch;
    window.asksEarly = false;
    window.fetch = async (url, options) => {
      window.asksEarly ||= Boolean(options) && options.body.includes(`"width":${whole},`) && liveView.width !== whole / 2;
      const answer = await fetchAtOnce(url, options);
      if (url.startsWith("/frame"))
        await wait(600);
      return answer;
    };
  }, width);
  await page.keyboard.press("ArrowLeft"); // the page already waits for this picture, and gets it at once
  await refined(page);
  await look(page, () => { asksEarly = false; });
  await page.mouse.down();
  await page.mouse.move(540, 400);
  await page.mouse.up();
  await shows(page, width / 2, height / 2);
  await shows(page, width, height);
  check(!await look(page, () => asksEarly), "no whole picture is asked for before the small one has come");
  await look(page, () => { window.fetch = fetchAtOnce; });

  await refined(page);
  await page.select("#moving", "auto");
  const whole = await look(page, () => liveView.stats.frame.total_ms), side = width / (whole <= 100 ? 1 : whole <= 400 ? 2 : 4);
  await page.mouse.down();
  await page.mouse.move(500, 400, {steps: 3});
  await shows(page, side, side * 3 / 4);
  await page.mouse.up();
  await shows(page, width, height);
  check(true, `while moving, where a frame takes ${whole.toFixed(0)} ms, it has ${side} pixels across`);
  await refined(page);
  const smooth = await keepDragging(page, wanted);
  await refined(page);
  console.log(`smooth, while the pointer goes on moving: ${median(smooth.took).toFixed(1)} ms from an event to its picture ` +
              `(median of ${smooth.took.length}), ${(smooth.frames / smooth.seconds).toFixed(1)} frames a second`);
  const least = 200; // two small frames, and what the browser does meanwhile
  check(median(smooth.took) <= Math.max(whole, least) + 30 + (isStrict ? 0 : alone), "that is the time of a whole frame, or 200 ms, and 30 ms at most");

  await page.click("#end");
  check(await job.ended === 0, "the button ends the job with 0");
  for (const viewer of [page, second])
    await until(viewer, () => liveView.state === "over");
  check(await page.$eval("#notice", e => e.textContent) === "The job has ended", "all pages say so");
  await page.close();
  await second.close();

  // ---- in_situ

  const simulation = await start(env.DFB_IN_SITU, "--size", "48", "--every", "20");
  const situ = await open(simulation.url);
  await shows(situ, width, height);
  const stepNow = () => look(situ, () => liveView.stats.frame.step);
  await until(situ, () => liveView.stats && liveView.stats.frame && liveView.stats.frame.step > 100);
  await drag(situ, [500, 400], [540, 380], 4);
  await situ.click("#pause");
  await until(situ, () => liveView.isPaused);
  // A turned picture is one of the step that it is paused at, which it reaches first.
  const turn = async () => {
    const known = await look(situ, () => liveView.latencies.length);
    await situ.keyboard.press("ArrowLeft");
    await until(situ, n => liveView.latencies.length > n, known);
    await refined(situ);
    return stepNow();
  };
  let at = await turn();
  for (let i = 0; i < 50 && (at % 20 !== 0 || await turn() !== at); ++i)
    at = await turn();
  check(at % 20 === 0 && await turn() === at, `paused at step ${at}, where the camera still turns`);
  await situ.screenshot({path: join(output, "in_situ.png")});
  await situ.click("#step");
  await until(situ, n => liveView.stats.frame.step === n, at + 20);
  check(await turn() === at + 20, "a step leads to the next picture, and no further");
  await situ.click("#pause");
  await until(situ, n => liveView.stats.frame.step > n, at + 100);
  check(true, "it goes on");
  await situ.click("#end");
  check(await simulation.ended === 0, "the button ends the simulation with 0");
  check(scriptErrors.length === 0, "the page's script has thrown nothing: " + scriptErrors.join(", "));
} catch (error) {
  console.error(error);
  process.exitCode = 1;
} finally {
  await browser.close();
  for (const job of jobs)
    if (job.exitCode === null)
      job.kill("SIGTERM");
  rmSync(scratch, {recursive: true, force: true});
}
