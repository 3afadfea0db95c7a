// Opens a trace in speedscope, in Chromium: node speedscope.mjs TRACE.json PICTURE.png; see speedscope.sh. Prints what
// speedscope has made of it: a profile for each row.
// Fails if it warns of spans that are not within each other.
import {createServer} from "node:http";
import {readFileSync} from "node:fs";
import {createRequire} from "node:module";
import {dirname, extname, join} from "node:path";

const require = createRequire(join(process.env.DFB_LIVE_NODE_MODULES, "index.js"));
const [trace, picture] = process.argv.slice(2);
const site = join(dirname(require.resolve("speedscope/package.json")), "dist/release");
const types = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".wasm": "application/wasm"};
const server = createServer((request, response) => {
  const path = request.url.split(/[?#]/)[0];
  try {
    const body = readFileSync(path === "/trace.json" ? trace : join(site, path));
    response.writeHead(200, {"Content-Type": types[extname(path)] || "application/octet-stream"});
    response.end(body);
  } catch {
    response.writeHead(404).end();
  }
}).listen(0, "127.0.0.1");
await new Promise(ready => server.on("listening", ready));
const browser = await require("puppeteer-core").launch({
  executablePath: process.env.DFB_CHROMIUM || "/usr/bin/chromium", headless: true,
  args: ["--no-sandbox", "--disable-dev-shm-usage"]});
try {
  const page = await browser.newPage();
  const errors = [];
  page.on("pageerror", error => errors.push(error.message));
  page.on("console", message => {
    if (/[Tt]ried to/.test(message.text()))
      errors.push(message.text());
  });
  page.on("dialog", dialog => { errors.push(dialog.message()); dialog.dismiss(); });
  await page.setViewport({width: 1400, height: 700});
  const url = `http://127.0.0.1:${server.address().port}/`;
  await page.goto(`${url}index.html#profileURL=${encodeURIComponent(url + "trace.json")}&title=trace.json`);
  // The title of the page and of its list: "NAME (1/12)".
  await page.waitForFunction(() => /\(\d+\/\d+\)/.test(document.body.innerText), {timeout: 60000});
  const shown = (await page.evaluate(() => document.body.innerText)).match(/(.*) \((\d+)\/(\d+)\)/);
  if (errors.length > 0)
    throw new Error(errors.join("; "));
  const rows = new Set(JSON.parse(readFileSync(trace)).traceEvents.filter(e => e.ph === "X").map(e => `${e.pid} ${e.tid}`));
  if (Number(shown[3]) !== rows.size)
    throw new Error(`${shown[3]} profiles of ${rows.size} rows`);
  if (picture)
    await page.screenshot({path: picture});
  console.log(`speedscope has opened it: ${shown[3]} rows, of which it shows ${shown[1].trim()}`);
} finally {
  await browser.close();
  server.close();
}
