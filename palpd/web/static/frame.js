// What every page has: the abort bar.

import "./abort.js";
