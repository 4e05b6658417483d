"""The paper's example of cost and reliability (section 3): where is a point in a noisy image? The
mean of n pictures is nearer to the truth than one, and costs n pictures."""

from petrobot import Context, Driver, Result, failure, key, success


class Camera(Driver):
    """Takes noisy pictures of one point; each gives its position with an error."""

    noise: float = key(1.0, "pixels, standard deviation in each direction", least=0)

    def locate(self) -> tuple[float, float]:
        x, y = self.ports.random("pictures").normal(0.0, self.noise, 2)
        return float(x), float(y)


async def _mean(ctx: Context[Camera], n: int, accuracy: float) -> Result:
    """Locate the point by the mean of n pictures; SUCCESS within `accuracy` (pixels)."""
    await ctx.sleep(0.02 * n)
    pictures = [ctx.device.locate() for _ in range(n)]
    x, y = (sum(axis) / n for axis in zip(*pictures, strict=True))
    error = float((x * x + y * y) ** 0.5)
    if error > accuracy:
        return failure("inaccurate", f"{error:.2f} pixels off", count=n, error=error)
    return success(count=n, error=error)


async def mean_of_1(ctx: Context[Camera], *, accuracy: float = 1.0) -> Result:
    return await _mean(ctx, 1, accuracy)


async def mean_of_2(ctx: Context[Camera], *, accuracy: float = 1.0) -> Result:
    return await _mean(ctx, 2, accuracy)


async def mean_of_3(ctx: Context[Camera], *, accuracy: float = 1.0) -> Result:
    return await _mean(ctx, 3, accuracy)


async def mean_of_5(ctx: Context[Camera], *, accuracy: float = 1.0) -> Result:
    return await _mean(ctx, 5, accuracy)


async def mean_of_8(ctx: Context[Camera], *, accuracy: float = 1.0) -> Result:
    return await _mean(ctx, 8, accuracy)


async def mean_of_13(ctx: Context[Camera], *, accuracy: float = 1.0) -> Result:
    return await _mean(ctx, 13, accuracy)
